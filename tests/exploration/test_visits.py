"""Parts of episodes, what a part reaches for the first time, and what that is worth."""

import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hmasd_jax.exploration.visits import (
    first_visits,
    largest_share,
    odds_against,
    pay,
    split_episodes,
)

RISES, FALLS = 0, 1


@pytest.mark.parametrize(
    ("period", "ends", "under_way"),
    [
        (0, [False, False, False, True, False, False], 2),
        (2, [True, False, True, True, False, True], 0),
        (4, [False, False, True, True, False, False], 2),
        (9, [False, False, False, True, False, False], 2),
    ],
)
def test_a_part_ends_with_its_episode_or_after_a_period(period, ends, under_way):
    """One step of the first episode lies in the rollout before."""
    done = jnp.array([False, False, False, True, False, False])
    part_steps, part_ends = split_episodes(jnp.array([1]), done[:, None], period)
    assert_array_equal(part_ends[:, 0], ends)
    assert_array_equal(part_steps, under_way)


def visits(start, end, done, num_bins):
    """Return `first_visits` of one feature in one copy."""
    start, end, done = (jnp.array(x)[:, None] for x in (start, end, done))
    none = jnp.zeros((1, 2, 1, num_bins), bool)
    visited, is_first = first_visits(none, start[..., None], end[..., None], done)
    return visited[0, :, 0], is_first[:, 0, :, 0]


def test_only_the_first_visit_of_an_episode_counts():
    start, end = [0, 1, 0, 1, 0], [1, 0, 1, 0, 1]
    visited, is_first = visits(start, end, [False, False, False, True, False], 4)
    assert_array_equal(is_first[:, RISES, 1], [True, False, False, False, True])
    assert_array_equal(is_first[:, FALLS, 0], [False, True, False, False, False])
    assert_array_equal(is_first.sum((0, 2)), [2, 1])
    assert_array_equal(visited, [[0, 1, 0, 0], [0, 0, 0, 0]])


def test_a_step_reaches_where_it_ends_and_all_that_it_passes():
    _, is_first = visits([0, 0, 3, 3, 1], [0, 3, 1, 1, 0], [False] * 5, 5)
    rising = [[0, 0, 0, 0, 0], [0, 1, 1, 1, 0], [0, 0, 0, 0, 0], [0] * 5, [0] * 5]
    falling = [[0, 0, 0, 0, 0], [0, 0, 0, 0, 0], [0, 1, 1, 0, 0], [0] * 5, [1, 0, 0, 0, 0]]
    assert_array_equal(is_first[:, RISES], rising)
    assert_array_equal(is_first[:, FALLS], falling)


def test_worth_falls_from_the_largest_to_nothing():
    worth = odds_against(jnp.array([0.0, 1e-6, 0.1, 0.5, 1.0]), largest=20.0)
    assert_allclose(worth, [20.0, 20.0, 9.0, 1.0, 0.0], rtol=1e-5)


def test_the_largest_share_is_forgotten_down_to_that_of_the_moment():
    """Four parts ended, and one is under way. All, one and none of them came to the cells."""
    before, reached = jnp.array([0.5, 0.5, 0.5]), jnp.array([5.0, 1.0, 0.0])
    share = largest_share(before, reached, jnp.float32(4), forgetting=0.1)
    assert_allclose(share, [1.0, 0.45, 0.45])


def test_a_step_is_paid_its_cells_over_the_root_of_their_number():
    is_first = jnp.array([[True, True, True, True], [False, True, False, False], [False] * 4])
    assert_allclose(pay(is_first, jnp.array([1.0, 3.0, 5.0, 7.0])), [8.0, 3.0, 0.0])
