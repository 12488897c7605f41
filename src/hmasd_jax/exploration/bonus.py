"""The form of an exploration bonus, and the sum of several."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hmasd_jax.types import Key, Metrics


class Bonus(NamedTuple):
    """An exploration bonus as three pure functions."""

    init: Callable[[Key], Any]
    """`init(key)`: state before the first rollout."""
    reward: Callable[[Any, Float[Array, "B state"]], Float[Array, " B"]]
    """`reward(bonus_state, states)`: weighted bonus for each state reached in a rollout."""
    train: Callable[[Any, Float[Array, "B state"], Key], tuple[Any, Metrics]]
    """`train(bonus_state, states, key)`: learn from the states of a rollout."""


NO_BONUS = Bonus(
    init=lambda key: (),
    reward=lambda bonus_state, states: jnp.zeros(states.shape[:-1]),
    train=lambda bonus_state, states, key: (bonus_state, {}),
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

    def reward(pair, states):
        return first.reward(pair[0], states) + second.reward(pair[1], states)

    def train(pair, states, key: Key):
        keys = jax.random.split(key)
        one, metrics = first.train(pair[0], states, keys[0])
        other, more = second.train(pair[1], states, keys[1])
        return (one, other), metrics | more

    return Bonus(init, reward, train)
