"""Evaluating chunk by chunk gives the values and gradients of evaluating all steps at once."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.baselines.qmix.chunks import CHUNK_STEPS, over_chunks

T, B = 2 * CHUNK_STEPS + 5, 3  # Three chunks, the last with padding.
PARAMS = {"recurrent": jnp.float32(0.9), "input": jnp.float32(0.3)}
SCALE = jnp.float32(2.0)
CARRY = jnp.array([0.1, 0.2, 0.3])
STEPS = (jax.random.normal(jax.random.key(0), (T, B)), jnp.arange(T))


def evaluate(params, constants, carry, steps):
    """Run a recurrence, in which a step that is skipped or repeated would show."""

    def step(h, inputs):
        x, time = inputs
        h = jnp.tanh(params["recurrent"] * h + params["input"] * x)
        return h, (constants * h, time * h)

    return jax.lax.scan(step, carry, steps)


def loss(outputs):
    weight = jnp.sin(jnp.arange(T, dtype=float))[:, None]
    return sum((weight * x).sum() for x in outputs)


@pytest.mark.parametrize("longest", [T, T - 1])
def test_values_and_gradients_of_all_steps(longest):
    def chunked(params, carry):
        return loss(over_chunks(evaluate, params, SCALE, carry, STEPS, jnp.int32(longest)))

    def whole(params, carry):
        return loss(evaluate(params, SCALE, carry, STEPS)[1])

    for outputs, expected in zip(
        over_chunks(evaluate, PARAMS, SCALE, CARRY, STEPS, jnp.int32(longest)),
        evaluate(PARAMS, SCALE, CARRY, STEPS)[1],
    ):
        assert_allclose(outputs, expected, rtol=1e-6)
    gradients = jax.jit(jax.grad(chunked, (0, 1)))(PARAMS, CARRY)
    chex.assert_trees_all_close(gradients, jax.grad(whole, (0, 1))(PARAMS, CARRY), rtol=1e-5)


@pytest.mark.parametrize("longest", [0, 12, 13, 25])
def test_chunks_after_the_longest_episode_are_skipped(longest):
    size = -(-T // 3)
    evaluated = (longest // size + 1) * size

    def chunked(params):
        return loss(over_chunks(evaluate, params, SCALE, CARRY, STEPS, jnp.int32(longest)))

    def cut(params):
        outputs = evaluate(params, SCALE, CARRY, STEPS)[1]
        return loss([x.at[evaluated:].set(0.0) for x in outputs])

    outputs = over_chunks(evaluate, PARAMS, SCALE, CARRY, STEPS, jnp.int32(longest))
    assert all((x[evaluated:] == 0).all() for x in outputs)
    assert all((np.asarray(x)[1:evaluated] != 0).all() for x in outputs)
    chex.assert_trees_all_close(jax.grad(chunked)(PARAMS), jax.grad(cut)(PARAMS), rtol=1e-5)


def test_each_seed_of_a_batch_stops_at_its_own_end():
    longest = jnp.array([5, T - 1])

    def chunked(params, longest):
        return loss(over_chunks(evaluate, params, SCALE, CARRY, STEPS, longest))

    gradient = jax.grad(chunked)
    together = jax.vmap(gradient, (None, 0))(PARAMS, longest)
    alone = [gradient(PARAMS, end) for end in longest]
    expected = jax.tree.map(lambda *x: jnp.stack(x), *alone)
    chex.assert_trees_all_close(together, expected, rtol=1e-5)
