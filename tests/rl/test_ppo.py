"""Eq. 5 against hand arithmetic, and Table 1."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.rl.ppo import PPOConfig, has_choice, masked_mean, policy_loss, ppo_loss, value_loss


@pytest.mark.parametrize(
    ("ratio", "advantage", "objective"),
    [
        (1.1, 2.0, 2.2),  # inside the clip range: rho A
        (1.5, 2.0, 2.4),  # too much of a good thing: min(3.0, 1.2 * 2)
        (0.5, 2.0, 1.0),  # a good action became unlikely: min(1.0, 0.8 * 2), not clipped
        (0.5, -2.0, -1.6),  # a bad action is unlikely enough: min(-1.0, 0.8 * -2)
        (1.5, -2.0, -3.0),  # a bad action became likely: min(-3.0, 1.2 * -2), not clipped
    ],
)
def test_clipped_policy_objective(ratio, advantage, objective):
    old = jnp.array([-1.3])
    loss = policy_loss(old + jnp.log(ratio), old, jnp.array([advantage]), 0.2)
    assert_allclose(loss, -objective, rtol=1e-6)


def test_policy_gradient_vanishes_exactly_where_clipping_binds():
    gradient = jax.grad(
        lambda x: policy_loss(x, jnp.zeros(4), jnp.array([1.0, 1.0, -1.0, -1.0]), 0.2)
    )(jnp.log(jnp.array([1.1, 1.5, 0.5, 1.5])))
    # d(-rho A / 4) / d(log pi) = -rho A / 4 where not clipped: -1.1/4, 0, 0, 1.5/4.
    assert_allclose(gradient, [-0.275, 0.0, 0.0, 0.375], rtol=1e-6)


@pytest.mark.parametrize(
    ("value", "old_value", "target", "loss"),
    [
        # V moved by 0.1 < 0.2, both branches are equal: 3^2 / 2.
        (1.1, 1.0, 4.1, 4.5),
        # V moved 1 -> 2, clipped to 1.2. Target 3: max(1^2 / 2, 1.8^2 / 2) = 1.62.
        (2.0, 1.0, 3.0, 1.62),
        # V moved 1 -> 2, clipped to 1.2. Target 0: max(2^2 / 2, 1.2^2 / 2) = 2.
        (2.0, 1.0, 0.0, 2.0),
        # Huber: |e| = 12 > 10, so 10 * (12 - 5) = 70, of either sign.
        (12.0, 12.0, 0.0, 70.0),
        (-12.0, -12.0, 0.0, 70.0),
        # At the seam |e| = 10 both forms give 50.
        (0.0, 0.0, 10.0, 50.0),
    ],
)
def test_clipped_huber_value_loss(value, old_value, target, loss):
    result = value_loss(jnp.array([value]), jnp.array([old_value]), jnp.array([target]), 0.2, 10.0)
    assert_allclose(result, loss, rtol=1e-6)


def test_huber_slope_is_capped_on_both_sides():
    def loss(value, target):
        return value_loss(value, value, jnp.array([target]), 0.2, 10.0)

    for target in (1000.0, -1000.0):
        gradient = jax.grad(lambda v, t=target: loss(v, t))(jnp.zeros(1))
        # Both branches depend on V equally (V_old moves along); the tail has slope -+10.
        assert_allclose(gradient, [-np.sign(target) * 10.0])


def test_clipping_picks_the_worse_element_by_element_not_of_the_means():
    # Elements (clipped, unclipped): first (1.62, 0.5), second (0.72, 2.0).
    # Mean of maxima: (1.62 + 2.0) / 2 = 1.81; maximum of means would be 1.25.
    loss = value_loss(jnp.full(2, 2.0), jnp.full(2, 1.0), jnp.array([3.0, 0.0]), 0.2, 10.0)
    assert_allclose(loss, 1.81, rtol=1e-6)


def test_ppo_loss_is_the_weighted_sum_with_shared_values_broadcast():
    config = PPOConfig(value_coef=0.5)
    ratio = np.array([[1.0, 1.5]])  # (batch, agents)
    loss, metrics = ppo_loss(
        jnp.log(jnp.asarray(ratio)),
        jnp.zeros((1, 2)),
        jnp.ones((1, 2)),
        value=jnp.zeros((1, 1)),
        old_value=jnp.zeros((1, 1)),
        target=jnp.array([[1.0, 3.0]]),
        config=config,
    )
    # Policy: -(1.0 + 1.2) / 2 = -1.1. Value: (1/2 + 9/2) / 2 = 2.5. Sum: -1.1 + 0.5 * 2.5.
    assert_allclose(loss, 0.15, rtol=1e-5)
    assert_allclose(metrics["policy_loss"], -1.1, rtol=1e-6)
    assert_allclose(metrics["value_loss"], 2.5, rtol=1e-6)
    assert_allclose(metrics["ratio_error"], 0.5, rtol=1e-6)
    assert_allclose(metrics["clip_fraction"], 0.5)
    # E[rho - 1 - log rho] = (0 + 0.5 - ln 1.5) / 2
    assert_allclose(metrics["approx_kl"], (0.5 - np.log(1.5)) / 2, rtol=1e-5)


def test_impossible_actions_leave_the_gradient_finite():
    gradient = jax.grad(
        lambda x: policy_loss(x, jnp.array([-1.0, -30.0]), jnp.array([1.0, -1.0]), 0.2)
    )(jnp.array([-80.0, -1.0]))
    assert np.isfinite(gradient).all()


def test_agents_without_a_choice_are_left_out_of_the_policys_mean_only():
    # Agent 0 may do either of two things, agent 1 is dead: nothing but action 0.
    active = has_choice(jnp.array([[[True, False, True], [True, False, False]]]))
    np.testing.assert_array_equal(active, [[True, False]])
    loss, metrics = ppo_loss(
        jnp.log(jnp.array([[1.1, 1.0]])),
        jnp.zeros((1, 2)),
        jnp.array([[2.0, 9.0]]),
        value=jnp.zeros((1, 2)),
        old_value=jnp.zeros((1, 2)),
        target=jnp.array([[1.0, 3.0]]),
        config=PPOConfig(),
        active=active,
    )
    # Policy: -1.1 * 2. Value, of both: (1/2 + 9/2) / 2 = 2.5.
    assert_allclose(metrics["policy_loss"], -2.2, rtol=1e-6)
    assert_allclose(loss, 0.3, rtol=1e-5)


def test_a_mean_over_nothing_is_0():
    x = jnp.array([1.0, 5.0, 3.0])
    assert masked_mean(x) == 3
    assert masked_mean(x, jnp.array([True, False, True])) == 2
    assert masked_mean(x, jnp.zeros(3, bool)) == 0


def test_defaults_are_table_1():
    config = PPOConfig()
    table = {
        "num_envs": 32,  # rollout threads
        "hidden_size": 64,
        "adam_epsilon": 1e-5,  # optimizer epsilon
        "num_epochs": 15,  # ppo epoch
        "clip_epsilon": 0.2,  # clip param
        "num_minibatches": 1,  # num mini batch
        "value_coef": 1.0,  # value loss coef
        "gae_lambda": 0.95,
        "discount": 0.99,  # gamma
        "huber_delta": 10.0,
    }
    assert {name: getattr(config, name) for name in table} == table
