"""Orthogonal weights, alone and for several seeds at once, and uniform ones."""

import re

import chex
import jax
import jax.numpy as jnp
import pytest
from flax import linen as nn
from numpy.testing import assert_allclose

import envs_jax
from hmasd_jax.algorithms import ALGORITHMS
from hmasd_jax.networks.initializers import orthogonal, uniform

KEYS = jax.random.split(jax.random.key(0), 3)


def test_columns_are_orthogonal_with_the_gain_as_length():
    weights = orthogonal(2.0)(KEYS[0], (8, 5), jnp.float32)
    assert_allclose(weights.T @ weights, 4 * jnp.eye(5), atol=1e-5)


def test_weights_are_flax_own_also_for_several_seeds():
    def draw(initializer):
        return jax.vmap(lambda key: initializer(key, (8, 5), jnp.float32))(KEYS)

    chex.assert_trees_all_close(draw(orthogonal(2.0)), draw(nn.initializers.orthogonal(2.0)))


def test_uniform_weights_are_as_wide_as_pytorchs():
    weights = uniform(16)(KEYS[0], (16, 1000), jnp.float32)
    assert 0.249 < abs(weights).max() <= 0.25  # 1 / sqrt(16)
    assert_allclose(weights.mean(), 0.0, atol=0.005)
    assert_allclose(weights.std(), 0.5 / 12**0.5, rtol=0.02)


@pytest.mark.parametrize("name", ["hmasd", "mappo", "mat"])
def test_vmapped_init_decomposes_one_matrix_at_a_time(name):
    # Batched decompositions of matrices large enough wait for each other for ever on a CPU.
    entry = ALGORITHMS[name]
    algorithm = entry.make(envs_jax.make("alice_and_bob"), entry.config())
    program = jax.jit(jax.vmap(algorithm.init)).lower(KEYS).as_text()
    decompositions = re.findall(r'@lapack_\w+.*?num_batch_dims = "(\d)"', program)
    assert decompositions
    assert set(decompositions) == {"0"}
