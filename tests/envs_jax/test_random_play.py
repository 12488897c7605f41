"""Random play is uniform over legal actions."""

import jax
import jax.numpy as jnp
import numpy as np

import envs_jax


def test_random_actions_are_uniform_over_the_legal_ones():
    masks = np.array([[1, 1, 1, 1], [0, 1, 0, 1], [1, 0, 0, 0], [0, 0, 0, 1], [0, 1, 1, 1]], bool)
    num = 20_000
    action = envs_jax.random_actions(
        jax.random.key(0), jnp.broadcast_to(masks, (num, *masks.shape))
    )
    assert action.shape == (num, len(masks))
    shares = (action[..., None] == jnp.arange(4)).mean(0)
    np.testing.assert_allclose(
        shares, masks / masks.sum(1, keepdims=True), atol=0.015
    )  # Four standard errors.
    assert not shares[~masks].any()


def test_random_actions_of_agents_are_independent():
    action = envs_jax.random_actions(jax.random.key(0), jnp.ones((20_000, 2, 2), bool))
    joint = np.histogram2d(*np.asarray(action).T, bins=2)[0] / len(action)
    np.testing.assert_allclose(joint, 0.25, atol=0.015)
