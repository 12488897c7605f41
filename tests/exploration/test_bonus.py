"""The sum of two exploration bonuses."""

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.exploration.bonus import NO_BONUS, Bonus, add

STATES = jnp.arange(6.0).reshape(3, 2)


def constant(value, name):
    """Return a bonus that counts its rollouts and pays `value` times that number."""
    return Bonus(
        init=lambda key: jnp.float32(1),
        reward=lambda count, states: jnp.full(len(states), value * count),
        train=lambda count, states, key: (count + 1, {name: count}),
    )


def test_the_sum_pays_both_and_trains_each_on_its_own_state():
    both = add(constant(2.0, "a"), constant(3.0, "b"))
    state = both.init(jax.random.key(0))
    assert_allclose(both.reward(state, STATES), 5.0)
    state, metrics = both.train(state, STATES, jax.random.key(1))
    assert metrics == {"a": 1, "b": 1}
    assert_allclose(both.reward(state, STATES), 10.0)


@pytest.mark.parametrize("other", [constant(2.0, "a"), NO_BONUS])
def test_no_bonus_adds_nothing(other):
    assert add(NO_BONUS, other) is other
    assert add(other, NO_BONUS) is other
