"""Optional declarations of an environment, with defaults: names, events, places and views.

Pictures and reports of trained policies use them. Training never does. An environment declares each
by a member of the name below and inherits from nothing.
"""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from envs_jax.types import Environment, EnvState

Agent = tuple[str, tuple[int, int, int] | None]
"""Name of an agent, and its color in the picture (RGB) if known."""


@runtime_checkable
class CountsEvents(Protocol):
    """Environment that tells what its agents did in a step."""

    def events(
        self, before: EnvState, action: Int[Array, " agents"], after: EnvState
    ) -> dict[str, Float[Array, " agents"]]:
        """Count events by agent in the step that led from `before` to `after`.

        Keys are always the same and are shown as they are, e.g. "soup served".
        """
        ...


@runtime_checkable
class LocatesAgents(Protocol):
    """Environment whose agents have places in its picture."""

    def locate(self, env_state: EnvState) -> Float[Array, "agents 2"]:
        """Return each agent's x (to the right) and y (down) in pixels of `render(env_state)`.

        Agents without a place, such as dead units, are NaN.
        """
        ...


@runtime_checkable
class DrawsEpisodes(Protocol):
    """Environment that draws the states of an episode in one view, e.g. a part of its map."""

    def render_episode(self, env_states: Sequence[EnvState]) -> list[np.ndarray]:
        """Draw unbatched states as uint8 images of one shape (height, width, 3), on the host."""
        ...


def count_events(
    env: Environment, before: EnvState, action: Int[Array, " agents"], after: EnvState
) -> dict[str, Float[Array, " agents"]]:
    """Return the events of a step by agent; empty if the environment declares none."""
    if not isinstance(env, CountsEvents):
        return {}
    counts = env.events(before, action, after)
    return {name: jnp.asarray(count, jnp.float32) for name, count in counts.items()}


def locate_agents(env: Environment, env_state: EnvState) -> Float[Array, "agents 2"] | None:
    """Return the agents' places in the picture; None if the environment declares none."""
    if not isinstance(env, LocatesAgents):
        return None
    return jnp.asarray(env.locate(env_state), jnp.float32)


def cell_pixels(env: Environment, picture: np.ndarray) -> int:
    """Return the side of a cell of maps: `cell_pixels` of the environment, or 1/20 of its width."""
    return getattr(env, "cell_pixels", max(picture.shape[1] // 20, 1))


def draw_states(env: Environment, env_states: Sequence[EnvState]) -> list[np.ndarray]:
    """Draw the states of one episode, by `render` if the environment declares no other way."""
    if isinstance(env, DrawsEpisodes):
        return env.render_episode(env_states)
    return [env.render(env_state) for env_state in env_states]


def describe_agents(env: Environment) -> list[Agent]:
    """Return the agents' names and colors: `agent_names` and `agent_colors`, or numbers."""
    numbers = range(env.num_agents)
    names = getattr(env, "agent_names", [f"agent {i + 1}" for i in numbers])
    return list(zip(names, getattr(env, "agent_colors", [None for _ in numbers])))


def name_actions(env: Environment) -> tuple[str, ...]:
    """Return the names of the actions: `action_names` of the environment, or numbers."""
    names: Any = getattr(env, "action_names", None)
    return tuple(names or (f"action {index}" for index in range(env.num_actions)))
