"""Environments of this package as PettingZoo environments. Needs the package pettingzoo."""

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, Literal

import jax
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, Space
from pettingzoo import ParallelEnv

from envs_jax.choices import check_choice
from envs_jax.types import Environment, EnvState, TimeStep

ActionMasks = Literal["observation", "info"]


class ExportedParallelEnv(ParallelEnv):
    """An `Environment` as a stateful `ParallelEnv`; see `to_pettingzoo`.

    All agents receive the team reward and end together. Arrays are NumPy arrays. The info of an
    agent contains the numbers of `TimeStep.info`, and `action_mask`.
    """

    def __init__(
        self, env: Environment, seed: int = 0, action_masks: ActionMasks = "observation"
    ) -> None:
        """Wrap `env`. Agents are called agent_0, agent_1, and so on."""
        check_choice("action_masks", action_masks, ActionMasks)
        self.env = env
        self.render_mode = "rgb_array"
        self.metadata = {
            "name": type(env).__name__,
            "render_modes": ["rgb_array"],
            "is_parallelizable": True,
        }
        self.possible_agents = [f"agent_{index}" for index in range(env.num_agents)]
        self.agents: list[str] = []
        self.observation_spaces = {
            agent: _observation_space(env, action_masks) for agent in self.possible_agents
        }
        self.action_spaces = {agent: Discrete(env.num_actions) for agent in self.possible_agents}
        self.state_space = Box(-np.inf, np.inf, (env.state_dim,), np.float32)
        self._masks_in_obs = action_masks == "observation"
        self._key = _key(seed)
        self._env_state: EnvState = None
        self._timestep: TimeStep | None = None

    def observation_space(self, agent: str) -> Space:
        """Return the space of an agent's observations."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Discrete:
        """Return the space of an agent's actions, including illegal ones."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict | None = None
    ) -> tuple[dict[str, Any], dict[str, dict]]:
        """Start an episode.

        Args:
            seed: Seed of this and all later episodes; None continues the current random stream.
            options: Not used.

        Returns:
            Observations and infos by agent.
        """
        del options
        if seed is not None:
            self._key = _key(seed)
        reset, _ = _compile(self.env)
        self._key, self._env_state, timestep = reset(self._key)
        self.agents = list(self.possible_agents)
        timestep = self._remember(timestep)
        return self._observations(timestep), self._infos(timestep)

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict]]:
        """Advance one step.

        Returns:
            Observations, rewards, terminations, truncations and infos by agent.

        Raises:
            ValueError: The episode is over, or an action is missing.
        """
        if not self.agents:
            raise ValueError("no episode is running: call reset first")
        missing = [agent for agent in self.agents if agent not in actions]
        if missing:
            raise ValueError(f"actions has no entry for {missing[0]}; give one action per agent")
        _, step = _compile(self.env)
        action = np.array([actions[agent] for agent in self.agents], np.int32)
        self._key, self._env_state, timestep = step(self._key, self._env_state, action)
        timestep = self._remember(timestep)
        agents = self.agents
        if timestep.done:
            self.agents = []
        return (
            self._observations(timestep),
            dict.fromkeys(agents, float(timestep.reward)),
            dict.fromkeys(agents, bool(timestep.terminated)),
            dict.fromkeys(agents, bool(timestep.truncated)),
            self._infos(timestep),
        )

    def state(self) -> np.ndarray:
        """Return the global state, float32 (state_dim,)."""
        return np.array(self._last().state)

    def render(self) -> np.ndarray:
        """Draw the current state as a uint8 image (height, width, 3)."""
        self._last()
        return self.env.render(self._env_state)

    def close(self) -> None:
        """Do nothing; there is no window or file to close."""

    def _remember(self, timestep: TimeStep) -> TimeStep:
        self._timestep = jax.tree.map(np.asarray, timestep)
        return self._timestep

    def _last(self) -> TimeStep:
        if self._timestep is None:
            raise ValueError("no episode has started: call reset first")
        return self._timestep

    def _observations(self, timestep: TimeStep) -> dict[str, Any]:
        rows = np.array(timestep.obs)
        if not self._masks_in_obs:
            return dict(zip(self.possible_agents, rows))
        pairs = zip(rows, timestep.action_mask.astype(np.int8))
        each = [{"observation": row, "action_mask": mask} for row, mask in pairs]
        return dict(zip(self.possible_agents, each))

    def _infos(self, timestep: TimeStep) -> dict[str, dict]:
        numbers = {name: value.item() for name, value in timestep.info.items()}
        masks = timestep.action_mask.astype(np.int8)
        each = [numbers | {"action_mask": mask} for mask in masks]
        return dict(zip(self.possible_agents, each))


def _key(seed: int) -> jax.Array:
    if seed < 0:
        raise ValueError(f"seed must be at least 0, got {seed}")
    return jax.random.key(seed)


def _observation_space(env: Environment, action_masks: ActionMasks) -> Space:
    vector = Box(-np.inf, np.inf, (env.obs_dim,), np.float32)
    if action_masks == "info":
        return vector
    mask = Box(0, 1, (env.num_actions,), np.int8)
    return Dict({"observation": vector, "action_mask": mask})


@lru_cache(maxsize=64)
def _compile(env: Environment) -> tuple[Callable, Callable]:
    """Compile `reset` and `step`, with splitting of the key, once for equal environments."""

    def reset(key: jax.Array) -> tuple[jax.Array, EnvState, TimeStep]:
        key, key_reset = jax.random.split(key)
        return key, *env.reset(key_reset)

    def step(
        key: jax.Array, env_state: EnvState, action: jax.Array
    ) -> tuple[jax.Array, EnvState, TimeStep]:
        key, key_step = jax.random.split(key)
        return key, *env.step(key_step, env_state, action)

    return jax.jit(reset), jax.jit(step)
