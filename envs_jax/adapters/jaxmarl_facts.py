"""What there is to know of an environment of JaxMARL, whichever it is.

Environments are recognized by the names of their classes, so that nothing is imported.
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
"""Classes of games that pay every agent for itself."""
OPPONENTS = ("adversary_", "leadadversary_", "enemy_", "eve_")
"""What names of agents of another side begin with."""


class Shapes(NamedTuple):
    """What tracing an environment of JaxMARL tells."""

    env_state: Any
    """Its state as shapes and dtypes."""
    obs_dims: tuple[int, ...]
    """Length of each agent's observation, flattened."""
    state_dim: int
    info: tuple[str, ...]
    """Entries of its info that are passed on."""
    has_shaped_reward: bool


def check_agents(source: Any, label: str) -> None:
    """Refuse what is no team with discrete actions."""
    name = type(source).__name__
    others = [agent for agent in source.agents if str(agent).startswith(OPPONENTS)]
    if _is_one_of(source, SELF_INTERESTED) or 0 < len(others) < len(source.agents):
        reason = f"{others[0]} opposes the others" if others else "each agent is paid for itself"
        raise ValueError(f"{label}: {name} is no team task ({reason}); choose a cooperative one")
    for agent in source.agents:
        space = source.action_space(agent)
        if not hasattr(space, "n"):
            raise ValueError(
                f"{label}: {agent} of {name} acts in a {type(space).__name__} space; choose an "
                "environment, or an option of it, with discrete actions"
            )


def _is_one_of(source: Any, names: set[str]) -> bool:
    """Whether a class of these names is among `source`'s; spares importing theirs."""
    return any(cls.__name__ in names for cls in type(source).__mro__)


def their_limit(source: Any) -> int | None:
    """Steps after which JaxMARL ends an episode, if it says."""
    limit = getattr(source, "max_steps", None)
    return None if limit is None else int(limit) + _is_one_of(source, COUNTED_AFTERWARDS)


def time_limit(source: Any, wanted: int) -> int:
    """The time limit to use; `wanted` 0 stands for theirs."""
    limit = their_limit(source)
    if wanted < 0:
        raise ValueError(f"max_steps must be at least 1, or 0 for theirs, got {wanted}")
    if wanted == 0 and limit is None:
        name = type(source).__name__
        raise ValueError(f"max_steps is missing: {name} does not tell its time limit; give one")
    if limit is not None and wanted > limit:
        raise ValueError(
            f"max_steps {wanted} is more than the {limit} steps after which "
            f"{type(source).__name__} ends an episode itself; lower it, or raise theirs"
        )
    return wanted or limit or 0


def num_actions(source: Any) -> list[int]:
    """How many actions each agent has."""
    return [int(source.action_space(agent).n) for agent in source.agents]


@lru_cache(maxsize=64)
def trace(source: Any) -> Shapes:
    """Shapes without computing anything."""
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
    """The global state: theirs, or all observations."""
    if "world_state" in obs:
        given = obs["world_state"]
    elif hasattr(source, "get_world_state"):
        given = source.get_world_state(state)
    else:
        given = jnp.concatenate([obs[agent].reshape(-1) for agent in source.agents])
    return given.reshape(-1).astype(jnp.float32)


def available_actions(source: Any, state: Any) -> Mapping[str, Array]:
    """What each agent may do, of its own actions; all where they do not say."""
    for name in ("get_avail_actions", "get_legal_moves"):  # the latter: Hanabi
        try:
            if hasattr(source, name):
                return getattr(source, name)(state)
        except NotImplementedError:  # of the base class
            continue
    counts = zip(source.agents, num_actions(source))
    return {agent: jnp.ones(count, bool) for agent, count in counts}


def sides_alive(source: Any, state: Any) -> tuple[Bool[Array, ""], Bool[Array, ""]] | None:
    """Whether any ally lives, and any enemy, in SMAX; None for other environments."""
    alive = getattr(getattr(state, "state", None), "unit_alive", None)
    if alive is None:
        return None
    return alive[: source.num_allies].any(), alive[source.num_allies :].any()
