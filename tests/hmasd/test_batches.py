"""Low-level batches of a constructed rollout, computed by hand, and those of several copies."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.exploration.successes import ImitationConfig
from hmasd_jax.hmasd.batches import high_batch, low_batch, skill_pairs
from hmasd_jax.hmasd.rollout_phase import Rollout
from hmasd_jax.rl.value_norm import ValueNorm
from tests.helpers.constructed_rollout import UNIT, make_parts, make_rollout


def _low(parts, rollout, reward=(1, 2, 4, 8)):
    reward = jnp.array(reward, jnp.float32)[:, None, None]
    return low_batch(parts, {"critic": {}}, UNIT, rollout, reward)


def test_low_level_targets_run_through_changes_of_skill_to_a_fresh_team_skill():
    # V_l = 1, 2, 3, 4, then V_l(s = 40, Z' = 1) with memory 4: 40 + 10 + 400 = 450.
    #   A_3 = 8 + 225 - 4            = 229        target 233
    #   A_2 = 4 + 2 - 3   + A_3 / 4  = 60.25             63.25
    #   A_1 = 2 + 1.5 - 2 + A_2 / 4  = 16.5625           18.5625
    #   A_0 = 1 + 1 - 1   + A_1 / 4  = 5.140625          6.140625
    batch = _low(make_parts(), make_rollout())
    assert_allclose(batch.target.reshape(-1), [6.140625, 18.5625, 63.25, 233])
    advantage = np.array([5.140625, 16.5625, 60.25, 229])
    expected = (advantage - advantage.mean()) / advantage.std()
    assert_allclose(batch.advantage.reshape(-1), expected, rtol=1e-5)


def test_low_level_advantages_are_normalized_over_who_has_a_choice():
    # The agent dies with step 1: its last two advantages (above) do not count.
    rollout = make_rollout()
    timestep = rollout.transitions.timestep
    dead = jnp.arange(4)[:, None, None, None] >= 2
    mask = timestep.action_mask & (~dead | jnp.array([True, False]))
    transitions = rollout.transitions._replace(timestep=timestep._replace(action_mask=mask))
    advantage = np.array([5.140625, 16.5625, 60.25, 229])
    expected = (advantage - advantage[:2].mean()) / advantage[:2].std()
    batch = _low(make_parts(), rollout._replace(transitions=transitions))
    assert_allclose(batch.advantage.reshape(-1), expected, rtol=1e-5)


def test_the_low_levels_floor_is_in_units_of_its_rewards():
    advantage = np.array([5.140625, 16.5625, 60.25, 229])  # as above; their deviation is 90
    batch = _low(make_parts(low_advantage_floor=200.0), make_rollout())
    assert_allclose(batch.advantage.reshape(-1), (advantage - advantage.mean()) / 200, rtol=1e-5)
    plain = _low(make_parts(), make_rollout())
    low = _low(make_parts(low_advantage_floor=20.0), make_rollout())
    np.testing.assert_array_equal(low.advantage, plain.advantage)


def test_low_level_values_are_denormalized_for_gae():
    # Mean 3, deviation 2: V_3 = 4 stands for 11, the last 450 for 903; 8 + 451.5 = 459.5.
    norm = ValueNorm(*jnp.array([3.0, 13.0, 1.0]))
    batch = low_batch(make_parts(), {"critic": {}}, norm, make_rollout(), jnp.full((4, 1, 1), 8.0))
    assert_allclose(batch.target.reshape(-1)[3], 459.5, rtol=1e-5)


def test_time_limits_are_terminal_unless_bootstrapped_with_the_true_last_state():
    # The episode is cut with step 1, in state 15, where the critic's memory is 2.
    #   terminal:     A_1 = 2 - 2 = 0, target 2
    #   bootstrapped: V_l(15, Z = 0) = 15 + 200 = 215; target 2 + 107.5
    # Both: nothing flows back over the cut; step 0 gets 1 + 0.5 * 2 + 0.25 A_1.
    rollout = make_rollout(truncated=(0, 1, 0, 0))
    assert_allclose(_low(make_parts(), rollout).target.reshape(-1)[:2], [2.0, 2.0])
    batch = _low(make_parts(bootstrap_truncation=True), rollout)
    assert_allclose(batch.target.reshape(-1)[:2], [2 + 0.25 * 107.5, 109.5])
    rollout = make_rollout(terminated=(0, 1, 0, 0))
    batch = _low(make_parts(bootstrap_truncation=True), rollout)
    assert_allclose(batch.target.reshape(-1)[:2], [2.0, 2.0])


def test_each_sequence_begins_with_the_memory_of_its_first_step():
    batch = _low(make_parts(), make_rollout(terminated=(0, 0, 1, 0)))
    np.testing.assert_array_equal(batch.state[..., 0], [[0, 10], [20, 30]])
    np.testing.assert_array_equal(batch.memory.actor.reshape(-1), [0, 2])
    np.testing.assert_array_equal(batch.memory.critic.reshape(-1), [0, 2])
    np.testing.assert_array_equal(batch.first, [[True, False], [False, True]])
    np.testing.assert_array_equal(batch.skills[..., 1], [[0, 0], [1, 1]])
    np.testing.assert_array_equal(batch.action[..., 0], [[0, 1], [0, 1]])
    np.testing.assert_array_equal(batch.log_prob[..., 0], [[0, -1], [-2, -3]])
    np.testing.assert_array_equal(batch.value, [[1, 2], [3, 4]])


@pytest.mark.parametrize(
    ("discriminate", "states"),
    [("next", [10, 20, 30, 40]), ("outcome", [5, 15, 25, 35])],
)
def test_discriminators_see_what_came_after_the_step(discriminate, states):
    # `next` is what the following step starts from, across resets and at the rollout's end.
    pairs = skill_pairs(
        make_parts(discriminate=discriminate), make_rollout(terminated=(0, 1, 0, 1))
    )
    np.testing.assert_array_equal(pairs.state[:, 0, 0], states)
    np.testing.assert_array_equal(pairs.obs[:, 0, 0, 0], np.array(states) + 0.5)
    np.testing.assert_array_equal(pairs.skills[:, 0, 1], [0, 0, 1, 1])


def test_copies_do_not_mix():
    def stack(*rollouts):
        copies = [r._replace(env=r.env._replace(env_state=())) for r in rollouts]
        t = jax.tree.map(lambda *x: jnp.concatenate(x, 1), *(c.transitions for c in copies))
        rest = [
            jax.tree.map(lambda *x: jnp.concatenate(x, 0), *(getattr(c, f) for c in copies))
            for f in ("env", "memory", "next_assignment")
        ]
        return Rollout(t, *rest)

    one = make_rollout(terminated=(0, 1, 0, 0))
    two = make_rollout(reward=(0, 3, 0, 1), low_value=(5,) * 4)
    parts = make_parts(num_envs=2)
    reward = jnp.array([[1.0, 0], [2, 3], [4, 0], [8, 1]])[..., None]
    for rollout, order in ((stack(one, two), [0, 1]), (stack(two, one), [1, 0])):
        batch = low_batch(parts, {"critic": {}}, UNIT, rollout, reward[:, np.array(order)])
        targets = np.asarray(batch.target).reshape(2, 2, 2)  # (T / L, E, L)
        alone = [_low(make_parts(), one), _low(make_parts(), two, (0, 3, 0, 1))]
        for copy, index in enumerate(order):
            assert_allclose(targets[:, copy], alone[index].target[..., 0])
        high = partial(high_batch, params={}, norm=UNIT, key=jax.random.key(0))
        both = [high(make_parts(), rollout=r).target for r in (one, two)]
        expected = np.sort(np.concatenate(both).ravel())
        assert_allclose(np.sort(np.asarray(high(parts, rollout=rollout).target).ravel()), expected)


def test_low_advantages_are_normalized_by_copies_that_sample_and_blame_the_others(
    parts, trained, rollout
):
    """Two of the four copies of a real rollout count as greedy, and all as rewarded."""
    transitions = rollout.transitions
    outcome = transitions.outcome._replace(reward=jnp.ones_like(transitions.outcome.reward))
    rollout = rollout._replace(transitions=transitions._replace(outcome=outcome))
    greedy = replace(
        parts, config=replace(parts.config, imitation=ImitationConfig(greedy_copies=2))
    )
    reward = jax.random.normal(jax.random.key(2), rollout.transitions.action.shape)

    def advantage(parts):
        low = low_batch(parts, trained.discoverer.params, trained.discoverer_norm, rollout, reward)
        return low.advantage.reshape(-1, 4, *low.advantage.shape[1:])  # sequences, copies, ...

    blamed, sampled = advantage(greedy), advantage(parts)
    others = (sampled - sampled[:, 2:].mean()) / sampled[:, 2:].std()
    assert_allclose(blamed[:, 2:], others[:, 2:], atol=1e-3)
    assert_allclose(blamed[:, :2], np.minimum(others[:, :2] + 1, 0), atol=1e-3)
    assert (blamed[:, :2] < 0).any()
