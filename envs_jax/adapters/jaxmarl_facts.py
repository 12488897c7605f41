"""Properties of a JaxMARL environment.

Environments are recognized by the names of their classes, which avoids importing jaxmarl.
"""

from collections.abc import Mapping
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

COUNTED_AFTERWARDS = {"SimpleMPE", "SMAX", "EnemySMAX"}
"""Classes whose episodes take one step more than their `max_steps`."""
SELF_INTERESTED = {"CoinGame", "InTheGrid", "InTheGrid_2p", "InTheMatrix"}
"""Classes of games in which every agent has its own reward."""
OPPONENTS = ("adversary_", "leadadversary_", "enemy_", "eve_")
"""Prefixes of the names of agents of another side."""


class Shapes(NamedTuple):
    """Shapes of a JaxMARL environment, found by tracing it."""

    env_state: Any
    """Shapes and dtypes of its state."""
    obs_dims: tuple[int, ...]
    """Length of each agent's observation, flattened."""
    state_dim: int
    """Length of the global state."""
    info: tuple[str, ...]
    """Entries of its info that are passed on."""
    has_shaped_reward: bool
    """True if its info contains `shaped_reward`."""


def check_agents(source: Any, label: str) -> None:
    """Check that the agents are a team with discrete actions.

    Args:
        source: Environment of JaxMARL.
        label: Name of the setting that chose it, for the message.

    Raises:
        ValueError: Agents oppose each other, or an agent's actions are not discrete.
    """
    name = type(source).__name__
    others = [agent for agent in source.agents if str(agent).startswith(OPPONENTS)]
    if _is_one_of(source, SELF_INTERESTED) or 0 < len(others) < len(source.agents):
        reason = f"{others[0]} opposes the others" if others else "each agent has its own reward"
        raise ValueError(f"{label}: {name} is not a team task ({reason}); choose a cooperative one")
    for agent in source.agents:
        space = source.action_space(agent)
        if not hasattr(space, "n"):
            raise ValueError(
                f"{label}: {agent} of {name} acts in a {type(space).__name__} space; choose an "
                "environment, or an option of it, with discrete actions"
            )


def _is_one_of(source: Any, names: set[str]) -> bool:
    """Test by name whether `source` is an instance of one of these classes."""
    return any(cls.__name__ in names for cls in type(source).__mro__)


def their_limit(source: Any) -> int | None:
    """Return the steps after which JaxMARL ends an episode, or None if unknown."""
    limit = getattr(source, "max_steps", None)
    return None if limit is None else int(limit) + _is_one_of(source, COUNTED_AFTERWARDS)


def time_limit(source: Any, wanted: int) -> int:
    """Return the time limit to use.

    Args:
        source: Environment of JaxMARL.
        wanted: Time limit in environment steps; 0 takes that of `source`.

    Raises:
        ValueError: `wanted` is negative or exceeds the limit of `source`, or neither gives a limit.
    """
    limit = their_limit(source)
    if wanted < 0:
        raise ValueError(f"max_steps must be at least 1, or 0 for JaxMARL's, got {wanted}")
    if wanted == 0 and limit is None:
        name = type(source).__name__
        raise ValueError(f"max_steps is missing: {name} has no time limit of its own; give one")
    if limit is not None and wanted > limit:
        raise ValueError(
            f"max_steps {wanted} is more than the {limit} steps after which "
            f"{type(source).__name__} ends an episode itself; lower it, or raise that limit"
        )
    return wanted or limit or 0


def num_actions(source: Any) -> list[int]:
    """Return the number of actions of each agent."""
    return [int(source.action_space(agent).n) for agent in source.agents]


@lru_cache(maxsize=64)
def trace(source: Any) -> Shapes:
    """Trace an environment of JaxMARL for its shapes, without computing anything."""
    key = jax.random.key(0)
    obs, env_state = jax.eval_shape(source.reset, key)
    action = jax.ShapeDtypeStruct((), jnp.int32)
    actions = dict.fromkeys(source.agents, action)
    info = jax.eval_shape(source.step_env, key, env_state, actions)[-1]
    state = jax.eval_shape(partial(world_state, source), obs, env_state)
    shapes = ((), (len(source.agents),))
    numbers = [name for name, leaf in info.items() if getattr(leaf, "shape", None) in shapes]
    return Shapes(
        env_state=env_state,
        obs_dims=tuple(obs[agent].size for agent in source.agents),
        state_dim=state.size,
        info=tuple(name for name in numbers if name not in ("terminated", "truncated")),
        has_shaped_reward="shaped_reward" in info,
    )


def world_state(source: Any, obs: Mapping[str, Array], state: Any) -> Float[Array, " state"]:
    """Return the global state: that of `source`, or else all observations, concatenated."""
    if "world_state" in obs:
        given = obs["world_state"]
    elif hasattr(source, "get_world_state"):
        given = source.get_world_state(state)
    else:
        given = jnp.concatenate([obs[agent].reshape(-1) for agent in source.agents])
    return given.reshape(-1).astype(jnp.float32)


def available_actions(source: Any, state: Any) -> Mapping[str, Array]:
    """Return the legal actions of each agent among its own; all of them if `source` has no mask."""
    for name in ("get_avail_actions", "get_legal_moves"):  # The second is Hanabi's.
        try:
            if hasattr(source, name):
                return getattr(source, name)(state)
        except NotImplementedError:  # The base class raises this.
            continue
    counts = zip(source.agents, num_actions(source))
    return {agent: jnp.ones(count, bool) for agent, count in counts}


def sides_alive(source: Any, state: Any) -> tuple[Bool[Array, ""], Bool[Array, ""]] | None:
    """Return whether any ally and any enemy lives in SMAX; None for other environments."""
    alive = getattr(getattr(state, "state", None), "unit_alive", None)
    if alive is None:
        return None
    return alive[: source.num_allies].any(), alive[source.num_allies :].any()
