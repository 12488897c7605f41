"""Our environments as JaxMARL's; needs the package jaxmarl."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxmarl.environments.multi_agent_env import (
    MultiAgentEnv,
)
from jaxmarl.environments.spaces import Box, Discrete
from jaxtyping import Array, Bool, Float, Int

from envs_jax.types import Environment, EnvState, TimeStep


class ExportedState(NamedTuple):
    """What JaxMARL's code carries from step to step."""

    env_state: EnvState
    timestep: TimeStep
    """What was emitted last: JaxMARL asks the state for observations and legal actions."""
    step: Int[Array, "*batch"]
    """Steps taken in this episode."""

    @property
    def done(self) -> Bool[Array, "*batch"]:
        """The episode is over."""
        return self.timestep.done


class ExportedEnv(MultiAgentEnv):
    """One of our environments, with all that JaxMARL's trainers ask of theirs.

    Every agent is paid the team's reward. Observations also hold `world_state`, our global state,
    as those of SMAX do. Info holds ours, and `terminated` and `truncated`, each of shape (agents,)
    as their trainers expect. `step`, inherited, begins anew where an episode is over.
    """

    def __init__(self, env: Environment) -> None:
        """Agents are called agent_0, agent_1, and so on."""
        super().__init__(num_agents=env.num_agents)
        self.env = env
        self.max_steps = env.max_steps
        self.state_size = env.state_dim
        self.observation_spaces = {
            agent: Box(-jnp.inf, jnp.inf, (env.obs_dim,)) for agent in self.agents
        }
        self.action_spaces = {agent: Discrete(env.num_actions) for agent in self.agents}

    @property
    def name(self) -> str:
        """Name of our class."""
        return type(self.env).__name__

    @property
    def horizon(self) -> int:
        """Time limit in environment steps."""
        return self.max_steps

    @property
    def num_allies(self) -> int:
        """Number of agents, under the name that their SMAX trainers use."""
        return self.num_agents

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """All agents are of one class."""
        return {"agents": self.agents}

    def world_state_size(self) -> int:
        """Length of `world_state`."""
        return self.state_size

    def reset(self, key: jax.Array) -> tuple[dict[str, Array], ExportedState]:
        """Start an episode."""
        env_state, timestep = self.env.reset(key)
        state = ExportedState(env_state, timestep, jnp.int32(0))
        return self.get_obs(state), state

    def step_env(
        self, key: jax.Array, state: ExportedState, actions: dict[str, Array]
    ) -> tuple[dict[str, Array], ExportedState, dict[str, Array], dict[str, Array], dict[str, Any]]:
        """Advance one step; does not begin anew."""
        action = jnp.stack([jnp.asarray(actions[agent]).reshape(()) for agent in self.agents])
        env_state, timestep = self.env.step(key, state.env_state, action.astype(jnp.int32))
        state = ExportedState(env_state, timestep, state.step + 1)
        rewards = dict.fromkeys(self.agents, timestep.reward)
        dones = dict.fromkeys([*self.agents, "__all__"], timestep.done)
        ends = {"terminated": timestep.terminated, "truncated": timestep.truncated}
        shape = (self.num_agents,)
        info = {k: jnp.broadcast_to(v, shape) for k, v in (timestep.info | ends).items()}
        return self.get_obs(state), state, rewards, dones, info

    def get_obs(self, state: ExportedState) -> dict[str, Array]:
        """Each agent's observation, and the global state as `world_state`."""
        timestep = state.timestep
        obs = {agent: timestep.obs[index] for index, agent in enumerate(self.agents)}
        return obs | {"world_state": timestep.state}

    def get_world_state(self, state: ExportedState) -> Float[Array, " state"]:
        """The global state."""
        return state.timestep.state

    def get_avail_actions(self, state: ExportedState) -> dict[str, Array]:
        """Which actions are legal, by agent."""
        mask = state.timestep.action_mask
        return {agent: mask[index] for index, agent in enumerate(self.agents)}

    def render(self, state: ExportedState) -> np.ndarray:
        """Our picture, uint8 (height, width, 3)."""
        return self.env.render(state.env_state)
