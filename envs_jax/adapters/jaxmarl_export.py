"""Environments of this package as JaxMARL environments. Needs the package jaxmarl."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxmarl.environments.multi_agent_env import MultiAgentEnv
from jaxmarl.environments.spaces import Box, Discrete
from jaxtyping import Array, Bool, Float, Int

from envs_jax.types import Environment, EnvState, TimeStep


class ExportedState(NamedTuple):
    """State that JaxMARL's code carries from step to step."""

    env_state: EnvState
    timestep: TimeStep
    """Last output of the environment, since JaxMARL reads observations and masks from the state."""
    step: Int[Array, "*batch"]
    """Steps taken in this episode."""

    @property
    def done(self) -> Bool[Array, "*batch"]:
        """True if the episode is over."""
        return self.timestep.done


class ExportedEnv(MultiAgentEnv):
    """An `Environment` with the interface that JaxMARL's trainers use.

    Every agent receives the team reward. Observations also contain the global state as
    `world_state`, as in SMAX. Info contains the entries of `TimeStep.info`, and `terminated` and
    `truncated`, each of shape (agents,) as JaxMARL's trainers expect. The inherited `step` resets
    when an episode is over.
    """

    def __init__(self, env: Environment) -> None:
        """Wrap `env`. Agents are called agent_0, agent_1, and so on."""
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
        """Name of the environment's class."""
        return type(self.env).__name__

    @property
    def horizon(self) -> int:
        """Time limit in environment steps."""
        return self.max_steps

    @property
    def num_allies(self) -> int:
        """Number of agents, under the name that JaxMARL's SMAX trainers use."""
        return self.num_agents

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """Agents by class. All are of one class."""
        return {"agents": self.agents}

    def world_state_size(self) -> int:
        """Return the length of `world_state`."""
        return self.state_size

    def reset(self, key: jax.Array) -> tuple[dict[str, Array], ExportedState]:
        """Start an episode."""
        env_state, timestep = self.env.reset(key)
        state = ExportedState(env_state=env_state, timestep=timestep, step=jnp.int32(0))
        return self.get_obs(state), state

    def step_env(
        self, key: jax.Array, state: ExportedState, actions: dict[str, Array]
    ) -> tuple[dict[str, Array], ExportedState, dict[str, Array], dict[str, Array], dict[str, Any]]:
        """Advance one step, without a reset at the end of an episode."""
        action = jnp.stack([jnp.asarray(actions[agent]).reshape(()) for agent in self.agents])
        env_state, timestep = self.env.step(key, state.env_state, action.astype(jnp.int32))
        state = ExportedState(env_state=env_state, timestep=timestep, step=state.step + 1)
        rewards = dict.fromkeys(self.agents, timestep.reward)
        dones = dict.fromkeys([*self.agents, "__all__"], timestep.done)
        ends = {"terminated": timestep.terminated, "truncated": timestep.truncated}
        shape = (self.num_agents,)
        info = {k: jnp.broadcast_to(v, shape) for k, v in (timestep.info | ends).items()}
        return self.get_obs(state), state, rewards, dones, info

    def get_obs(self, state: ExportedState) -> dict[str, Array]:
        """Return each agent's observation, and the global state as `world_state`."""
        timestep = state.timestep
        obs = {agent: timestep.obs[index] for index, agent in enumerate(self.agents)}
        return obs | {"world_state": timestep.state}

    def get_world_state(self, state: ExportedState) -> Float[Array, " state"]:
        """Return the global state."""
        return state.timestep.state

    def get_avail_actions(self, state: ExportedState) -> dict[str, Array]:
        """Return the legal actions of each agent."""
        mask = state.timestep.action_mask
        return {agent: mask[index] for index, agent in enumerate(self.agents)}

    def render(self, state: ExportedState) -> np.ndarray:
        """Draw a state as a uint8 image (height, width, 3)."""
        return self.env.render(state.env_state)
