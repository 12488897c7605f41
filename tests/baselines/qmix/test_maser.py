"""Subgoals, distances and losses of MASER, by hand; what its two variants train."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

from hmasd_jax.baselines.qmix import maser


def test_subgoals_mix_own_and_total_value_and_are_never_padding():
    values = jnp.array([[[1.0, 4.0]], [[3.0, 0.0]], [[2.0, 1.0]], [[9.0, 9.0]]])  # (T, B = 1, N)
    total = jnp.array([[0.0], [2.0], [8.0], [9.0]])
    valid = jnp.array([[True], [True], [True], [False]])

    def steps(individual_weight):
        return maser.subgoals(values, total, valid, individual_weight)[0].tolist()

    assert steps(1.0) == [1, 0]  # own values alone: 3 and 4
    assert steps(0.0) == [2, 2]  # the total alone: 8
    # Half of each: (0.5, 2, 3) and (2, 0.5, 2.5), from own / 2 + total / 4.
    assert steps(0.5) == [2, 2]
    assert steps(0.7) == [2, 0]  # (0.7, 2.4, 2.6) and (2.8, 0.3, 1.9)


def test_distances_are_euclidean_and_have_finite_gradients_at_the_subgoal():
    features = jnp.array([[[[0.0, 0.0]]], [[[3.0, 4.0]]]])  # (T, B, N, 2)
    goal = jnp.array([[0]])
    assert_allclose(maser.distances(features, goal)[:, 0, 0], [0.0, 5.0], atol=1e-5)
    gradient = jax.grad(lambda x: maser.distances(x, goal).sum())(features)
    assert_allclose(gradient[1, 0, 0], [0.6, 0.8], rtol=1e-6)
    assert_allclose(gradient[0, 0, 0], [-0.6, -0.8], rtol=1e-6)


def test_individual_loss_by_hand():
    credit = jnp.log(jnp.array([[[1.0, 3.0]], [[1.0, 1.0]]]))  # weights 1/4, 3/4; 1/2, 1/2
    values = SimpleNamespace(
        taken=jnp.array([[[0.0, 1.0]], [[2.0, 2.0]]]),
        greedy=jnp.array([[[9.0, 9.0]], [[4.0, 2.0]], [[50.0, 50.0]]]),
    )
    episodes = SimpleNamespace(
        terminated=jnp.array([[False], [True]]), valid=jnp.array([[True], [True]])
    )
    own = jnp.array([[[-1.0, 0.0]], [[0.0, -1.0]]])
    reward = jnp.array([[4.0], [2.0]])
    loss = maser.individual_loss(values, credit, reward, own, episodes, discount=0.5)
    # Targets 1 - 1 + 4/2 = 2, 3 + 0 + 2/2 = 4; 1 + 0, 1 - 1. Errors -2, -3; 1, 2.
    assert_allclose(loss, (4 + 9 + 1 + 4) / 2)


def test_exploration_loss_is_the_divergence_from_uniform_after_the_subgoal():
    values = jnp.log(jnp.array([[[[9.0, 1.0]]], [[[3.0, 1.0]]], [[[1.0, 1.0]]], [[[7.0, 1.0]]]]))
    valid = jnp.array([[True], [True], [True], [False]])
    loss = maser.exploration_loss(values, jnp.array([[1]]), valid)
    divergence = 0.75 * np.log(0.75 / 0.5) + 0.25 * np.log(0.25 / 0.5)
    assert_allclose(loss, (divergence + 0) / 2, rtol=1e-5)


def test_distance_loss_by_hand():
    values = jnp.array([[[[1.0, 0.0]]], [[[0.0, 2.0]]], [[[5.0, 5.0]]]])
    distance = jnp.array([[[0.5]], [[0.5]], [[9.0]]])
    valid = jnp.array([[True], [True], [False]])
    # The subgoal is step 0: cosines 1 and 0, so distances 0 and 1 are right.
    loss = maser.distance_loss(distance, values, jnp.array([[0]]), valid)
    assert_allclose(loss, 0.25, rtol=1e-5)
