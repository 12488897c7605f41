"""The form of an exploration bonus, and the sum of several."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from envs_jax import TimeStep
from hmasd_jax.types import Key, Metrics


def always_one(bonus_state: Any, copies: bool | Bool[Array, " E"] = True) -> float:
    """Return 1, for a bonus that leaves entropy as it is, or counts no solved episodes."""
    del bonus_state, copies
    return 1.0


class Bonus(NamedTuple):
    """An exploration bonus as pure functions."""

    init: Callable[[Key], Any]
    """`init(key)`: state before the first rollout."""
    update: Callable[[Any, TimeStep, Key], tuple[Any, Float[Array, "T E"], Metrics]]
    """`update(bonus_state, outcome, key)`: the next state, the weighted bonus for each state that a
    rollout reached, and metrics. `outcome` is (T, E), before any reset."""
    entropy_weight: Callable[[Any], float | Float[Array, ""]] = always_one
    """`entropy_weight(bonus_state)`: factor of the coefficient of the actions' entropy, which
    explores, too."""
    unsolved: Callable[..., float | Float[Array, ""]] = always_one
    """`unsolved(bonus_state, copies=True)`: share of recent episodes that were not solved, in
    the copies of the environment that are marked."""


NO_BONUS = Bonus(
    init=lambda key: (),
    update=lambda bonus_state, outcome, key: (bonus_state, jnp.zeros_like(outcome.reward), {}),
)


def add(first: Bonus, second: Bonus) -> Bonus:
    """Return the sum of two bonuses. Its state is the pair of theirs, if both pay anything."""
    if first is NO_BONUS:
        return second
    if second is NO_BONUS:
        return first

    def init(key: Key):
        keys = jax.random.split(key)
        return first.init(keys[0]), second.init(keys[1])

    def update(pair, outcome: TimeStep, key: Key):
        keys = jax.random.split(key)
        one, reward, metrics = first.update(pair[0], outcome, keys[0])
        other, more_reward, more_metrics = second.update(pair[1], outcome, keys[1])
        return (one, other), reward + more_reward, metrics | more_metrics

    def entropy_weight(pair):
        return first.entropy_weight(pair[0]) * second.entropy_weight(pair[1])

    def unsolved(pair, copies=True):
        return jnp.minimum(first.unsolved(pair[0], copies), second.unsolved(pair[1], copies))

    return Bonus(init, update, entropy_weight, unsolved)
