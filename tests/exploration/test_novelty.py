"""The novelty bonus: large for new states, fading for old ones, in units of its own deviation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import envs_jax
from hmasd_jax.exploration.bonus import NO_BONUS
from hmasd_jax.exploration.novelty import NoveltyConfig, make_novelty, measure
from tests.helpers.rollouts import outcome_of

ENV = envs_jax.make("alice_and_bob")


def reward_of(bonus, state, states):
    """Return the reward that the bonus pays for states (T, E, ...)."""
    _, reward, _ = bonus.update(state, outcome_of(states), jax.random.key(3))
    return reward


@pytest.fixture(scope="module")
def learned():
    """A bonus that has seen the same states for a hundred rollouts, and these states."""
    bonus = make_novelty(ENV, NoveltyConfig(coef=0.5, learning_rate=1e-3))
    states = jax.random.normal(jax.random.key(0), (8, 8, ENV.state_dim))

    @jax.jit
    def train(key):
        def step(state, key):
            state, _, metrics = bonus.update(state, outcome_of(states), key)
            return state, metrics

        key_init, key_train = jax.random.split(key)
        return jax.lax.scan(step, bonus.init(key_init), jax.random.split(key_train, 100))

    state, metrics = train(jax.random.key(1))
    return bonus, state, states, metrics


def test_the_error_on_known_states_fades(learned):
    *_, metrics = learned
    error = np.asarray(metrics["novelty_error"])
    assert error[-1] < 0.3 * error[0]


def test_new_states_pay_more_than_known_ones(learned):
    bonus, state, states, _ = learned
    new = 3.0 * jax.random.normal(jax.random.key(2), states.shape)
    both = reward_of(bonus, state, jnp.concatenate([states, new]))
    assert both[8:].mean() > 2.0 * both[:8].mean()


def test_the_bonus_is_the_weighted_error_in_units_of_its_deviation(learned):
    bonus, state, states, _ = learned
    errors, so_far = measure(state, states.reshape(64, -1))
    expected = 0.5 * errors.reshape(8, 8) / np.sqrt(so_far.variance + 1e-8)
    assert_allclose(reward_of(bonus, state, states), expected, rtol=1e-5)


def test_without_a_weight_there_is_no_state_and_no_bonus():
    bonus = make_novelty(ENV, NoveltyConfig())
    assert bonus is NO_BONUS
    assert jax.tree.leaves(bonus.init(jax.random.key(0))) == []
    np.testing.assert_array_equal(reward_of(bonus, (), jnp.ones((3, 2, ENV.state_dim))), 0.0)


def test_negative_weights_are_refused():
    with pytest.raises(ValueError, match="coef must be at least 0, got -1"):
        NoveltyConfig(coef=-1)
