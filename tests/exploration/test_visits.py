"""Parts of episodes, and the bins that a part reaches for the first time."""

import jax.numpy as jnp
import pytest
from numpy.testing import assert_array_equal

from hmasd_jax.exploration.visits import first_visits, split_episodes

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
