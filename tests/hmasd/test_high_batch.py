"""High-level batches and segments of a constructed rollout, computed by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.hmasd.batches import find_segments, high_batch
from hmasd_jax.rl.value_norm import ValueNorm
from tests.helpers.constructed_rollout import UNIT, make_parts, make_rollout


def _high(parts, rollout):
    """Targets by the step at which the segment begins, {t: (team's, agent's)}."""
    batch = high_batch(parts, {}, UNIT, rollout, jax.random.key(0))
    return batch, {int(s) // 10: tuple(t) for s, t in zip(batch.state[:, 0], batch.target.tolist())}


def test_one_sample_per_segment_with_targets_by_gae():
    # r^h = 1 + 2 = 3 and 4 + 8 = 12; V_h = (1, 2), (3, 4), then (5, 6); gamma = lambda = 0.5.
    #   delta_1 = 12 + 0.5 (5, 6) - (3, 4) = (11.5, 11)
    #   delta_0 =  3 + 0.5 (3, 4) - (1, 2) = (3.5, 3)
    #   A_0 = delta_0 + 0.25 delta_1 = (6.375, 5.75)
    # Targets A + V: (7.375, 7.75) and (14.5, 15).
    batch, targets = _high(make_parts(), make_rollout())
    assert targets == {0: (7.375, 7.75), 2: (14.5, 15.0)}
    # Advantages are normalized over segments and tokens together.
    values = np.array([[1, 2], [3, 4]])[np.asarray(batch.state[:, 0], int) // 20]
    advantage = np.asarray(batch.target) - values
    expected = (advantage - advantage.mean()) / (advantage.std() + 1e-5)
    assert_allclose(batch.advantage, expected, rtol=1e-5)
    # State, observation and skills are those at which the skills were drawn.
    assert_allclose(batch.obs[:, 0, 0], batch.state[:, 0] + 0.5)
    np.testing.assert_array_equal(batch.assignment.skills[:, 1], batch.state[:, 0] == 20)


def test_values_are_denormalized_for_gae():
    # With mean 3 and deviation 2 the normalized values 1, 2, 3, .. stand for 5, 7, 9, ..
    #   delta_1 = 12 + 0.5 (13, 15) - (9, 11) = (9.5, 8.5);  target (18.5, 19.5)
    norm = ValueNorm(*jnp.array([3.0, 13.0, 1.0]))
    batch = high_batch(make_parts(), {}, norm, make_rollout(), jax.random.key(0))
    last = batch.target[batch.state[:, 0] == 20]
    assert_allclose(last, [[18.5, 19.5]], rtol=1e-5)


def test_an_episode_that_ends_with_the_segment_cuts_the_return():
    # delta_0 = 3 - (1, 2), and nothing flows back from the second segment: target (3, 3).
    for end in ({"terminated": (0, 1, 0, 0)}, {"truncated": (0, 1, 0, 0)}):
        _, targets = _high(make_parts(), make_rollout(**end))
        assert targets == {0: (3.0, 3.0), 2: (14.5, 15.0)}


def test_by_the_rollouts_clock_an_end_inside_a_segment_is_not_seen():
    _, targets = _high(make_parts(), make_rollout(terminated=(1, 0, 0, 0)))
    assert targets == {0: (7.375, 7.75), 2: (14.5, 15.0)}


def test_by_the_episodes_clock_the_end_of_an_episode_ends_the_segment():
    # The episode ends with step 0, so segments are (0), (1, 2), (3), the last cut by the rollout's
    # end. Rewards 1, 6, 8; V_h (1, 2), (1, 2), (3, 4), then (5, 6).
    #   A_2 = 8 + 0.5 (5, 6) - (3, 4)                      = (7.5, 7)    target (10.5, 11)
    #   A_1 = 6 + 0.5 (3, 4) - (1, 2) + 0.25 A_2           = (8.375, 7.75)      (9.375, 9.75)
    #   A_0 = 1 - (1, 2)                                                        (1, 1)
    parts = make_parts(segment_clock="episode")
    rollout = make_rollout(terminated=(1, 0, 0, 0), renewed=(1, 1, 0, 1))
    batch, targets = _high(parts, rollout)
    assert targets == {0: (1.0, 1.0), 1: (9.375, 9.75), 3: (10.5, 11.0)}
    # Twice T / k slots: all three segments, and one of them again.
    assert len(batch.target) == 4


def test_by_the_episodes_clock_a_segment_begun_earlier_has_no_sample_in_this_rollout():
    # Steps 0 and 1 belong to a segment of the previous rollout, which has bootstrapped there.
    parts = make_parts(segment_clock="episode")
    _, targets = _high(parts, make_rollout(renewed=(0, 0, 1, 0)))
    assert targets == {2: (14.5, 15.0)}


@pytest.mark.parametrize("clock", ["rollout", "episode"])
def test_a_time_limit_can_be_bootstrapped_at_the_high_level(clock):
    # The time limit cuts the episode with step 1, in state 15: V_h = (35, 36).
    #   delta_0 = 3 + 0.5 (35, 36) - (1, 2), nothing flows back: target (20.5, 21).
    parts = make_parts(bootstrap_truncation=True, segment_clock=clock)
    _, targets = _high(parts, make_rollout(truncated=(0, 1, 0, 0)))
    assert targets[0] == (20.5, 21.0)
    # A terminated episode is not bootstrapped even so.
    _, targets = _high(parts, make_rollout(terminated=(0, 1, 0, 0)))
    assert targets[0] == (3.0, 3.0)


def test_the_guard_drops_the_policy_term_exactly_when_all_segment_rewards_are_equal():
    guarded, plain = make_parts(zero_reward_guard=True), make_parts()
    equal, unequal = make_rollout(reward=(0, 2, 2, 0)), make_rollout(reward=(0, 2, 2, 1))
    assert (_high(guarded, equal)[0].advantage == 0).all()
    assert (abs(_high(plain, equal)[0].advantage) > 0.1).all()
    np.testing.assert_array_equal(
        _high(guarded, unequal)[0].advantage, _high(plain, unequal)[0].advantage
    )
    # The values go on learning.
    np.testing.assert_array_equal(_high(guarded, equal)[0].target, _high(plain, equal)[0].target)


def test_segments_know_their_own_end():
    segments = find_segments(make_parts(), {}, make_rollout(terminated=(1, 0, 0, 1)))
    np.testing.assert_array_equal(segments.begins[:, 0], [True, False, True, False])
    np.testing.assert_array_equal(segments.done[:, 0], [False, False, True, True])


def test_only_what_the_coordinator_sampled_is_in_the_high_level_batch(parts, trained, rollout):
    """Two copies act greedily, say, and of the others the first segment is random."""
    extras = rollout.transitions.extras
    sampled = extras.sampled.at[:, :2].set(False).at[0].set(False)
    transitions = rollout.transitions._replace(extras=extras._replace(sampled=sampled))
    high = high_batch(
        parts, trained.coordinator.params, trained.coordinator_norm,
        rollout._replace(transitions=transitions), jax.random.key(0),
    )  # fmt: skip
    others = extras.assignment.value[5:, 2:].reshape(-1, high.target.shape[-1])
    assert all((value == others).all(-1).any() for value in high.assignment.value)


def test_a_rollout_of_random_segments_teaches_the_values_alone(parts, trained, rollout):
    """All of its segments are there, and none has an advantage."""
    extras = rollout.transitions.extras
    none = extras._replace(sampled=jnp.zeros_like(extras.sampled))
    high = high_batch(
        parts, trained.coordinator.params, trained.coordinator_norm,
        rollout._replace(transitions=rollout.transitions._replace(extras=none)), jax.random.key(0),
    )  # fmt: skip
    assert (high.advantage == 0).all()
    all_values = extras.assignment.value[extras.renewed]
    assert len(np.unique(high.assignment.value[:, 0])) == len(np.unique(all_values[:, 0])) > 1
