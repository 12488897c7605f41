"""The bonus for rare values of single features."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import envs_jax
from hmasd_jax.exploration.bonus import NO_BONUS
from hmasd_jax.exploration.counts import CountsConfig, count, make_counts, measure, widen

ENV = envs_jax.make("probe_match_cue")
SIZE = ENV.state_dim


def states_of(*values):
    """Return states whose first feature has these values. The others are 0."""
    return jnp.zeros((len(values), SIZE)).at[:, 0].set(jnp.array(values))


@pytest.fixture
def bonus():
    return make_counts(ENV, CountsConfig(coef=0.5, num_bins=4, threshold=1.5))


@pytest.fixture
def empty(bonus):
    return bonus.init(jax.random.key(0))


def test_visits_are_counted_in_bins_between_the_extremes(empty):
    counts = count(empty, states_of(0.0, 0.9, 1.1, 3.0, 4.0))
    assert_allclose(counts.visits[0], [2, 1, 0, 2])
    assert_allclose(counts.visits[1:, 0], 5)
    assert_allclose((counts.low[0], counts.high[0]), (0.0, 4.0))


def test_a_wider_range_moves_old_visits_to_the_bin_of_their_middle(empty):
    """Bins of [0, 4] have their middles at 0.5, 1.5, 2.5, 3.5; those of [0, 8] are 2 wide."""
    counts = count(empty, states_of(0.0, 0.9, 1.1, 3.0, 4.0))
    wider = widen(counts, states_of(0.0)[0], states_of(8.0)[0])
    assert_allclose(wider.visits[0], [3, 2, 0, 0])
    assert_allclose(wider.visits.sum(1), 5)


def test_rarity_is_the_sum_of_inverse_roots_of_visits(empty):
    states = states_of(0.0, 0.0, 0.0, 0.0, 4.0)
    rarity = measure(count(empty, states), states)
    others = (SIZE - 1) / np.sqrt(5)
    assert_allclose(rarity[0], 1 / np.sqrt(4) + others, rtol=1e-6)
    assert_allclose(rarity[4], 1 + others, rtol=1e-6)


def test_the_bonus_is_what_exceeds_the_threshold_in_deviations_of_the_rollout(bonus, empty):
    states = states_of(0.0, 0.0, 0.0, 0.0, 4.0)
    rarity = np.array([0.5] * 4 + [1.0])
    excess = (rarity - rarity.mean()) / rarity.std()
    assert_allclose(excess[-1], 2.0)
    assert_allclose(bonus.reward(empty, states), [0, 0, 0, 0, 0.5 * (2.0 - 1.5)], rtol=1e-4)


def test_what_has_become_common_pays_no_more(bonus, empty):
    counts = empty
    for _ in range(50):
        counts, _ = bonus.train(counts, states_of(1.0, 1.0, 1.0, 2.0, 3.0), jax.random.key(0))
    new = bonus.reward(counts, states_of(*[1.0] * 5, 2.0, 3.0, 4.0))
    assert new[-1] > 0
    assert_allclose(new[:-1], 0.0)


def test_features_that_never_change_pay_nothing(bonus, empty):
    assert_allclose(bonus.reward(empty, states_of(1.0, 1.0, 1.0)), 0.0, atol=1e-3)


def test_without_a_weight_there_is_no_bonus():
    assert make_counts(ENV, CountsConfig()) is NO_BONUS


@pytest.mark.parametrize(("field", "value"), [("coef", -1), ("num_bins", 1), ("threshold", -1)])
def test_settings_out_of_range_are_refused(field, value):
    with pytest.raises(ValueError, match=f"{field} must be at least .*, got {value}"):
        CountsConfig(**{field: value})
