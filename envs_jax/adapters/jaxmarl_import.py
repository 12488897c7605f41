"""Conversion of environments of JaxMARL (github.com/FLAIROx/JaxMARL, version 0.2).

- Agents are in the order of `agents`. Observations are flattened and padded with zeros to the
  longest one. Actions are padded to the largest number, and the added ones are illegal.
- `state` is JaxMARL's `world_state` (SMAX), or else the result of `get_world_state`, or else all
  observations, concatenated as in JaxMARL's own trainers
  (`jaxmarl.wrappers.baselines.CTRolloutManager`).
- The team reward is the mean of the agents' rewards. If all agents receive the same reward, as in
  Overcooked, SMAX and Hanabi, the mean equals it. If each agent has its own part, as in MPE, the
  sum is the mean times the number of agents.
- An episode has as many steps as in JaxMARL. Some of its environments check the step count before
  they increase it, so that MPE with `max_steps` 25 takes 26 steps and SMAX with 100 takes 101.
- JaxMARL has one flag, done, for both ends of an episode. It becomes `truncated` at the time limit,
  unless a side of SMAX is dead by then, and `terminated` before. An entry `truncated` of JaxMARL's
  info takes precedence.
- `info` contains those entries of JaxMARL's info that are one number, or one number per agent (then
  their mean). They are 0 at reset. SMAX also has `success`: all enemies are dead and an ally lives.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs_jax.adapters import jaxmarl_facts as facts
from envs_jax.adapters import jaxmarl_pictures as pictures
from envs_jax.choices import check_choice
from envs_jax.types import TimeStep

TeamReward = Literal["mean", "sum"]


class ImportedState(NamedTuple):
    """Simulator state of one episode."""

    state: Any
    """State of JaxMARL's environment."""
    time: Int[Array, "*batch"]
    """Steps taken."""


@dataclass(frozen=True, kw_only=True)
class JaxMARLTask:
    """Base class of converted JaxMARL environments. A subclass provides `source`."""

    max_steps: int = 0
    """Time limit in environment steps. 0 takes JaxMARL's; a smaller one ends episodes earlier."""
    team_reward: TeamReward = "mean"
    """Team reward: `mean` or `sum` of the agents' rewards."""
    shaped_reward_coef: float = 0.0
    """Coefficient of JaxMARL's shaped reward (Overcooked) in each agent's reward."""

    label: ClassVar[str] = "env"
    """Name of the setting that chooses the environment, for error messages."""

    def __post_init__(self) -> None:
        facts.check_agents(self.source, self.label)
        object.__setattr__(self, "max_steps", facts.time_limit(self.source, self.max_steps))
        check_choice("team_reward", self.team_reward, TeamReward)
        if not math.isfinite(self.shaped_reward_coef):
            raise ValueError(f"shaped_reward_coef must be finite, got {self.shaped_reward_coef}")
        if self.shaped_reward_coef and not self._shapes.has_shaped_reward:
            name = type(self.source).__name__
            raise ValueError(
                f"shaped_reward_coef {self.shaped_reward_coef}: {name} has no shaped reward; "
                "leave it at 0"
            )

    @property
    def source(self) -> Any:
        """The environment of JaxMARL."""
        raise NotImplementedError

    @property
    def num_agents(self) -> int:
        """Number of agents."""
        return len(self.source.agents)

    @property
    def num_actions(self) -> int:
        """Largest number of actions of an agent."""
        return max(facts.num_actions(self.source))

    @property
    def obs_dim(self) -> int:
        """Length of the longest observation of an agent."""
        return max(self._shapes.obs_dims)

    @property
    def state_dim(self) -> int:
        """Length of the global state vector."""
        return self._shapes.state_dim

    @property
    def agent_names(self) -> tuple[str, ...]:
        """JaxMARL's names of the agents, in its order."""
        return tuple(self.source.agents)

    @property
    def _shapes(self) -> facts.Shapes:
        return facts.trace(self.source)

    def reset(self, key: jax.Array) -> tuple[ImportedState, TimeStep]:
        """Start an episode by JaxMARL's `reset`."""
        obs, state = self.source.reset(key)
        state = _cast(state, self._shapes.env_state)
        not_over = jnp.bool(False)
        info = dict.fromkeys(self._shapes.info, jnp.float32(0))
        timestep = self._timestep(obs, state, jnp.float32(0), not_over, not_over, info)
        return ImportedState(state, jnp.int32(0)), timestep

    def step(
        self, key: jax.Array, env_state: ImportedState, action: Int[Array, " agents"]
    ) -> tuple[ImportedState, TimeStep]:
        """Advance one step by JaxMARL's `step_env`, which never resets."""
        actions = {agent: action[index] for index, agent in enumerate(self.source.agents)}
        obs, state, rewards, dones, info = self.source.step_env(key, env_state.state, actions)
        state = _cast(state, self._shapes.env_state)
        time = env_state.time + 1
        over = jnp.asarray(dones["__all__"], bool)
        terminated = over & ~self._is_time_up(state, time, info)
        truncated = (over | (time >= self.max_steps)) & ~terminated
        numbers = {name: _mean(info[name]) for name in self._shapes.info}
        reward = self._team_reward(rewards, info)
        timestep = self._timestep(obs, state, reward, terminated, truncated, numbers)
        return ImportedState(state, time), timestep

    def render(self, env_state: ImportedState) -> np.ndarray:
        """Draw Overcooked by JaxMARL, SMAX and MPE as discs, and others as a strip of numbers."""
        return pictures.draw(self.source, env_state.state)

    def _is_time_up(
        self, state: Any, time: Int[Array, ""], info: Mapping[str, Any]
    ) -> Bool[Array, ""]:
        """Return whether the end of an episode, if it is over, is due to the time limit only."""
        if "truncated" in info:
            return jnp.any(info["truncated"])
        limit = facts.their_limit(self.source)
        if limit is None:
            return jnp.bool(False)
        sides = facts.sides_alive(self.source, state)
        return time >= limit if sides is None else sides[0] & sides[1]

    def _team_reward(
        self, rewards: Mapping[str, Array], info: Mapping[str, Any]
    ) -> Float[Array, ""]:
        each = jnp.stack([rewards[agent] for agent in self.source.agents])
        if self.shaped_reward_coef:
            shaped = info["shaped_reward"]
            shaped = jnp.stack([shaped[agent] for agent in self.source.agents])
            each = each + self.shaped_reward_coef * shaped
        total = each.sum() if self.team_reward == "sum" else each.mean()
        return total.astype(jnp.float32)

    def _timestep(
        self,
        obs: Mapping[str, Array],
        state: Any,
        reward: Float[Array, ""],
        terminated: Bool[Array, ""],
        truncated: Bool[Array, ""],
        info: dict[str, Array],
    ) -> TimeStep:
        """Convert JaxMARL's outputs to a `TimeStep`."""
        rows = [obs[agent].reshape(-1) for agent in self.source.agents]
        sides = facts.sides_alive(self.source, state)
        if sides is not None:
            allies, enemies = sides
            info = info | {"success": (allies & ~enemies).astype(jnp.float32)}
        return TimeStep(
            obs=jnp.stack([_pad(row, self.obs_dim) for row in rows]).astype(jnp.float32),
            state=facts.world_state(self.source, obs, state),
            action_mask=self._action_mask(state),
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            info=info,
        )

    def _action_mask(self, state: Any) -> Bool[Array, "agents actions"]:
        legal = facts.available_actions(self.source, state)
        rows = [_pad(legal[agent].astype(bool), self.num_actions) for agent in self.source.agents]
        return jnp.stack(rows)


@dataclass(frozen=True, kw_only=True)
class WrappedJaxMARL(JaxMARLTask):
    """JaxMARL environment given as an object; see `from_jaxmarl`."""

    env: Any
    """The environment of JaxMARL; compared by identity."""

    @property
    def source(self) -> Any:
        """The environment of JaxMARL."""
        return self.env


def _cast(state: Any, like: Any) -> Any:
    """Convert `state` to the dtypes that it has when `reset` is traced, none of them weak.

    Some environments of JaxMARL change dtypes between `reset` and `step`, which `jax.lax.scan`
    refuses.
    """
    return jax.tree.map(lambda x, to: jax.lax.convert_element_type(x, to.dtype), state, like)


def _pad(row: Array, length: int) -> Array:
    return jnp.pad(row, (0, length - len(row)))


def _mean(value: Array) -> Float[Array, ""]:
    return jnp.mean(value, dtype=jnp.float32)
