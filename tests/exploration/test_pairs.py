"""Pairs of features whose joint values few parts of episodes reach."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import envs_jax
from hmasd_jax.exploration.frontier import make_frontier
from hmasd_jax.exploration.frontier_config import FrontierConfig
from hmasd_jax.exploration.pairs import (
    MOST_PAIRS,
    choose_pairs,
    find_cells,
    first_cells,
    init_pairs,
    visit_pairs,
)
from tests.helpers.rollouts import outcome_of

CONFIG = FrontierConfig(coef=0.5, pair_coef=0.1, window=10, forgetting=0.0)


def cells_of(*episodes):
    """Return cells (T, E, 1) of two features, from the pairs of their bins in each episode."""
    return find_cells(jnp.array(episodes).swapaxes(0, 1))


def test_all_pairs_of_few_features_are_counted():
    assert_array_equal(choose_pairs(3), [[0, 1], [0, 2], [1, 2]])


def test_pairs_of_many_features_are_drawn_once_and_for_all():
    pairs = choose_pairs(75)
    assert len(np.unique(pairs, axis=0)) == len(pairs) == MOST_PAIRS
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert_array_equal(pairs, choose_pairs(75))


def test_a_cell_joins_the_bins_of_both_features():
    assert_array_equal(find_cells(jnp.array([[3, 0, 2], [1, 2, 3]])), [[12, 14, 2], [6, 7, 11]])


def test_a_part_comes_to_each_cell_for_the_first_time_once():
    cells = cells_of([(0, 0), (3, 0), (0, 0), (3, 0), (0, 3)])
    ends = jnp.array([[False], [False], [True], [False], [False]])
    none = init_pairs(2, 1)
    visited, reached, is_first = first_cells(none.visited, none.reached, cells, ends)
    assert_array_equal(is_first[:, 0, 0], [True, True, False, True, True])
    assert visited == 2**3 + 2**12
    assert_array_equal(reached[0, [0, 3, 12]], [1, 1, 2])
    _, reached, is_first = first_cells(visited, reached, cells, ends)
    assert_array_equal(is_first[:, 0, 0], [True, False, False, True, True])
    assert_array_equal(reached[0, [0, 3, 12]], [2, 2, 3])


def test_a_joint_value_is_paid_where_no_single_value_is_new():
    """Each of four episodes raises both features. One of them raises both at a time."""
    apart, together = [(0, 0), (3, 0), (0, 3)], [(3, 0), (0, 3), (3, 3)]
    cells = cells_of(apart, apart, apart, together)
    ends = jnp.zeros((3, 4), bool).at[-1].set(True)
    pairs, bonus = visit_pairs(init_pairs(2, 4), cells, ends, CONFIG)
    # Recent are 0.9 x 4 parts that are assumed at the start, and these four.
    assert_allclose(pairs.mastered[0, [0, 12, 3, 15]], jnp.array([3, 4, 4, 1]) / 7.6, rtol=1e-6)
    three, four, one = (7.6 / n - 1 for n in (3, 4, 1))
    assert_allclose(bonus[:, 0], [three, four, four], rtol=1e-5)
    assert_allclose(bonus[:, 3], [four, four, one], rtol=1e-5)


def test_what_every_part_comes_to_pays_nothing():
    cells = cells_of(*[[(0, 0), (3, 3)]] * 4)
    ends = jnp.array([[False] * 4, [True] * 4])
    pairs = init_pairs(2, 4)
    for _ in range(80):
        pairs, bonus = visit_pairs(pairs, cells, ends, CONFIG)
    assert_allclose(bonus, 0.0, atol=1e-3)


def test_several_cells_at_a_time_are_paid_over_the_root_of_their_number():
    """Three features make three pairs, and each step comes to a new cell of each."""
    cells = find_cells(jnp.array([[[0, 0, 0]], [[3, 3, 3]]]))
    _, bonus = visit_pairs(init_pairs(3, 1), cells, jnp.array([[False], [True]]), CONFIG)
    assert_allclose(bonus, 3 / 3**0.5 * (1.9 - 1), rtol=1e-5)


@pytest.fixture(scope="module")
def env():
    return envs_jax.make("overcooked", layout="cramped_room", state="kitchen")


def play(env, config, best_return):
    """Return the state of the bonus after a rollout of random states, its reward, and metrics."""
    bonus = make_frontier(env, config, 4)
    frontier = bonus.init(jax.random.key(0))._replace(best_return=jnp.float32(best_return))
    outcome = outcome_of(jax.random.normal(jax.random.key(1), (5, 4, env.state_dim)))
    outcome = outcome._replace(truncated=outcome.truncated.at[-1].set(True))
    return jax.jit(bonus.update)(frontier, outcome, jax.random.key(2))


def test_pairs_count_once_an_episode_earns_more_than_one_reward(env):
    single = FrontierConfig(coef=0.5)
    pairs = FrontierConfig(coef=0.5, pair_coef=0.1)
    before, reward, _ = play(env, pairs, best_return=1)
    assert not before.pairs.visited.any()
    assert not before.pairs.mastered.any()
    assert_array_equal(reward, play(env, single, best_return=1)[1])
    after, reward, _ = play(env, pairs, best_return=2)
    assert after.pairs.mastered.any()
    alone, single_reward, _ = play(env, single, best_return=2)
    assert alone.pairs == ()
    assert jnp.abs(reward - single_reward).max() > 0.01


def test_the_weight_of_pairs_scales_what_they_add(env):
    def mean_bonus(weight):
        config = FrontierConfig(coef=0.5, pair_coef=weight)
        return play(env, config, best_return=2)[2]["frontier"]

    single = mean_bonus(0.0)
    assert_allclose(mean_bonus(0.2) - single, 2 * (mean_bonus(0.1) - single), rtol=1e-3)


def test_pairs_without_the_frontier_are_refused():
    with pytest.raises(ValueError, match="pair_coef needs coef above 0"):
        FrontierConfig(pair_coef=0.1)


def test_a_negative_weight_is_refused():
    with pytest.raises(ValueError, match=r"pair_coef must be .*, got -0\.1"):
        FrontierConfig(coef=1.0, pair_coef=-0.1)
