"""Generalized advantage estimation against hand arithmetic and its two limits."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.rl import value_norm
from hmasd_jax.rl.gae import gae, normalize_advantage, rollout_advantage
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.rl.value_norm import ValueNorm


def test_three_steps_by_hand():
    # gamma = 0.5, lambda = 0.5, no episode ends. delta_t = r_t + 0.5 V'_t - V_t:
    #   delta_2 = 3 + 0.5 * 6 - 1 = 5
    #   delta_1 = 2 + 0.5 * 1 - 2 = 0.5
    #   delta_0 = 1 + 0.5 * 2 - 4 = -2
    # A_t = delta_t + 0.25 A_{t+1}:  A_2 = 5, A_1 = 0.5 + 1.25 = 1.75, A_0 = -2 + 0.4375 = -1.5625
    # R_t = A_t + V_t = 2.4375, 3.75, 6
    never = jnp.zeros(3, bool)
    advantage, target = gae(
        jnp.array([1.0, 2.0, 3.0]),
        jnp.array([4.0, 2.0, 1.0]),
        jnp.array([2.0, 1.0, 6.0]),
        terminated=never,
        done=never,
        discount=0.5,
        gae_lambda=0.5,
    )
    assert_allclose(advantage, [-1.5625, 1.75, 5.0])
    assert_allclose(target, [2.4375, 3.75, 6.0])


@pytest.mark.parametrize(
    ("terminated", "advantage"),
    [
        (False, 1 + 0.9 * 10 - 2),  # cut by the time limit: bootstraps from V' = 10
        (True, 1 - 2),  # the task ended: nothing follows
    ],
)
def test_truncation_bootstraps_and_termination_does_not(terminated, advantage):
    # Step 0 ends an episode; step 1 is in the next one, and its advantage 50 must not flow back.
    result, _ = gae(
        jnp.array([1.0, 50.0]),
        jnp.array([2.0, 0.0]),
        jnp.array([10.0, 0.0]),
        terminated=jnp.array([terminated, False]),
        done=jnp.array([True, False]),
        discount=0.9,
        gae_lambda=1.0,
    )
    assert_allclose(result, [advantage, 50.0], rtol=1e-6)


def _random_inputs():
    rng = np.random.default_rng(0)
    reward, value = rng.normal(size=(2, 6, 3))
    last = rng.normal(size=(1, 3))
    done = rng.random((6, 3)) < 0.3
    assert done.any()
    assert not done.all()
    return reward, value, np.concatenate([value[1:], last]), done


def test_lambda_zero_is_the_td_error():
    reward, value, next_value, done = _random_inputs()
    advantage, target = gae(reward, value, next_value, done, done, 0.9, 0.0)
    td_target = reward + 0.9 * next_value * (1 - done)
    assert_allclose(target, td_target, rtol=1e-5, atol=1e-6)
    assert_allclose(advantage, td_target - value, rtol=1e-5, atol=1e-6)


def test_lambda_one_is_the_return_minus_the_value():
    reward, value, next_value, done = _random_inputs()
    advantage, target = gae(reward, value, next_value, done, done, 0.9, 1.0)
    returns, following = np.zeros_like(reward), next_value[-1]
    for t in reversed(range(len(reward))):
        following = reward[t] + 0.9 * following * (1 - done[t])
        returns[t] = following
    assert_allclose(target, returns, rtol=1e-5, atol=1e-5)
    assert_allclose(advantage, returns - value, rtol=1e-5, atol=1e-5)


def test_shared_values_broadcast_over_the_agents_own_rewards():
    reward, value, next_value, done = _random_inputs()
    per_agent = np.stack([reward, 2 * reward], axis=-1)  # (T, E, N) against (T, E, 1)
    shared = [x[..., None] for x in (value, next_value, done, done)]
    advantage, _ = gae(per_agent, *shared, 0.9, 0.95)
    for agent, scale in enumerate((1, 2)):
        alone, _ = gae(scale * reward, value, next_value, done, done, 0.9, 0.95)
        assert_allclose(advantage[..., agent], alone, rtol=1e-5, atol=1e-6)


def test_copies_do_not_mix():
    inputs = _random_inputs()
    order = np.array([2, 0, 1])
    reward, value, next_value, done = inputs
    straight, _ = gae(reward, value, next_value, done, done, 0.9, 0.95)
    reward, value, next_value, done = (x[:, order] for x in inputs)
    permuted, _ = gae(reward, value, next_value, done, done, 0.9, 0.95)
    np.testing.assert_array_equal(permuted, straight[:, order])


def test_normalized_values_must_be_denormalized_first():
    # Statistics of mean 3 and standard deviation 2: square - mean^2 = 13 - 9 = 4.
    norm = ValueNorm(jnp.float32(3), jnp.float32(13), jnp.float32(1))
    reward, value, next_value, done = _random_inputs()
    through_norm, _ = gae(
        reward,
        value_norm.denormalize(norm, jnp.asarray(value)),
        value_norm.denormalize(norm, jnp.asarray(next_value)),
        done,
        done,
        0.9,
        0.95,
    )
    by_hand, _ = gae(reward, 2 * value + 3, 2 * next_value + 3, done, done, 0.9, 0.95)
    assert_allclose(through_norm, by_hand, rtol=1e-5, atol=1e-5)
    raw, _ = gae(reward, value, next_value, done, done, 0.9, 0.95)
    assert abs(through_norm - raw).max() > 0.5


def test_advantages_are_normalized_with_the_population_deviation():
    # mean 3; deviations -2, 0, 2; population variance 8 / 3 (sample variance would be 4).
    result = normalize_advantage(jnp.array([[1.0], [3.0], [5.0]]))
    assert_allclose(result[:, 0], np.array([-2, 0, 2]) / (np.sqrt(8 / 3) + 1e-5), rtol=1e-6)


def test_constant_advantages_become_zero_rather_than_nan():
    np.testing.assert_array_equal(normalize_advantage(jnp.full((4, 2), 7.0)), 0.0)


def test_the_floor_of_the_deviation_is_1e_5():
    # Deviations of +-1e-5 are divided by 1e-5 + 1e-5, so they come out as +-0.5.
    assert_allclose(normalize_advantage(jnp.array([-1e-5, 1e-5])), [-0.5, 0.5], rtol=1e-5)


def test_a_higher_floor_keeps_small_advantages_small():
    small, large = jnp.array([-0.5, 0.5]), jnp.array([-4.0, 4.0])
    assert_allclose(normalize_advantage(small, floor=2.0), [-0.25, 0.25], rtol=1e-6)
    assert_allclose(normalize_advantage(large, floor=2.0), [-1.0, 1.0], rtol=1e-4)


def test_normalization_takes_mean_and_deviation_from_active_agents_only():
    # Active: 1 and 5, mean 3, deviation 2. The others are shifted and scaled alike: (9 - 3) / 2.
    result = normalize_advantage(jnp.array([1.0, 9.0, 5.0]), jnp.array([True, False, True]))
    assert_allclose(result, [-1.0, 3.0, 1.0], rtol=1e-4)
    assert_allclose(
        normalize_advantage(jnp.array([1.0, 2.0]), jnp.ones(2, bool)), [-1, 1], rtol=1e-4
    )
    assert np.isfinite(normalize_advantage(jnp.ones(2), jnp.zeros(2, bool))).all()


@pytest.mark.parametrize(("bootstrap", "targets"), [(False, [2.0, 2.0]), (True, [5.5, 6.0])])
def test_a_rollouts_targets_end_or_bootstrap_at_a_time_limit(bootstrap, targets):
    # One copy, two steps of reward 2, each cut by the time limit; lambda = 0, gamma = 0.5.
    # The steps cut off are worth 7 and 8. Those of new episodes must not count.
    outcome = SimpleNamespace(
        done=jnp.ones((2, 1), bool),
        truncated=jnp.ones((2, 1), bool),
        terminated=jnp.zeros((2, 1), bool),
    )
    one = value_norm.ValueNorm(jnp.float32(0), jnp.float32(1), jnp.float32(1))  # deviation 1
    _, target = rollout_advantage(
        jnp.full((2, 1, 1), 2.0),
        jnp.full((2, 1, 1), 100.0),
        jnp.full((1, 1), 100.0),
        outcome,
        lambda: jnp.array([7.0, 8.0]).reshape(2, 1, 1),
        one,
        PPOConfig(discount=0.5, gae_lambda=0.0, bootstrap_truncation=bootstrap),
    )
    assert_allclose(target[:, 0, 0], targets, rtol=1e-6)


def test_a_rollouts_last_step_is_bootstrapped_from_what_follows_it():
    no = jnp.zeros((2, 1), bool)
    outcome = SimpleNamespace(done=no, truncated=no, terminated=no)
    two = value_norm.ValueNorm(jnp.float32(0), jnp.float32(4), jnp.float32(1))  # deviation 2
    _, target = rollout_advantage(
        jnp.zeros((2, 1, 1)), jnp.array([1.0, 3.0]).reshape(2, 1, 1), jnp.full((1, 1), 5.0),
        outcome, lambda: None, two, PPOConfig(discount=0.5, gae_lambda=0.0),
    )  # fmt: skip
    # 0.5 * 2 * 3 and 0.5 * 2 * 5
    assert_allclose(target[:, 0, 0], [3.0, 5.0], rtol=1e-6)
