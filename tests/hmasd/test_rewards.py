"""Eq. 4 and r^h by hand."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.rewards import high_level_reward, low_level_reward

COEFFICIENTS = {
    "extrinsic_coef": 100.0,
    "team_intrinsic_coef": 0.1,
    "individual_intrinsic_coef": 0.5,
}


def test_eq_4_by_hand():
    # Two steps, two agents. Step 0: 100 * 1 + 0.1 * -2 + 0.5 * (-1, -4) = (99.3, 97.8).
    # Step 1: 100 * 0 + 0.1 * -1 + 0.5 * (0, -2) = (-0.1, -1.1).
    reward = low_level_reward(
        jnp.array([1.0, 0.0]),
        jnp.array([-2.0, -1.0]),
        jnp.array([[-1.0, -4.0], [0.0, -2.0]]),
        HMASDConfig(**COEFFICIENTS),
    )
    assert_allclose(reward, [[99.3, 97.8], [-0.1, -1.1]], rtol=1e-6)


def test_the_weight_of_skills_leaves_the_team_reward_as_it_is():
    inputs = jnp.array([1.0]), jnp.array([-2.0]), jnp.array([[-1.0, -4.0]])
    reward = low_level_reward(*inputs, HMASDConfig(**COEFFICIENTS), skill_weight=3.0)
    assert_allclose(reward, [[100 - 0.6 - 1.5, 100 - 0.6 - 6.0]], rtol=1e-6)


def test_with_the_prior_a_useless_discriminator_pays_nothing_and_a_perfect_one_log_n():
    config = HMASDConfig(num_team_skills=2, num_skills=4, skill_prior=True, **COEFFICIENTS)
    uniform = low_level_reward(
        jnp.zeros(1), jnp.full(1, -np.log(2)), jnp.full((1, 2), -np.log(4)), config
    )
    assert_allclose(uniform, 0.0, atol=1e-6)
    # log q = 0 for both: 0.1 ln 2 + 0.5 ln 4.
    perfect = low_level_reward(jnp.zeros(1), jnp.zeros(1), jnp.zeros((1, 2)), config)
    assert_allclose(perfect, 0.1 * np.log(2) + 0.5 * np.log(4), rtol=1e-6)


def test_without_the_prior_every_step_costs_what_the_discriminators_do_not_know():
    # Paper's Alice_and_Bob, untrained q: -(0.1 ln 2 + 0.2 ln 4) = -0.35 per step.
    reward = low_level_reward(
        jnp.zeros(1), jnp.full(1, -np.log(2)), jnp.full((1, 2), -np.log(4)), HMASDConfig()
    )
    assert_allclose(reward, -0.3466, rtol=1e-3)


@pytest.mark.parametrize("copies", [(), (2,)])
def test_the_high_level_reward_sums_to_the_end_of_each_segment_undiscounted(copies):
    # Segments of steps (0, 1, 2), (3), (4, 5): 1 + 2 + 4 = 7, 8, 16 + 32 = 48.
    reward = 2.0 ** np.arange(6)
    last = np.array([0, 0, 1, 1, 0, 1], bool)
    expected = np.array([7, 6, 4, 8, 48, 32.0])
    spread = [np.broadcast_to(x.reshape(6, *[1] * len(copies)), (6, *copies)) for x in
              (reward, last, expected)]  # fmt: skip
    assert_allclose(high_level_reward(jnp.asarray(spread[0]), jnp.asarray(spread[1])), spread[2])
