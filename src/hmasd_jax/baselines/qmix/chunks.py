"""Evaluation of replayed episodes chunk by chunk in time, up to the end of the longest one.

The arrays of a chunk fit a CPU's cache, and battles often end after a fourth of the longest time.
Only the carry before each chunk is kept for the gradient, which evaluates the chunk again.
"""

from collections.abc import Callable
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

CHUNK_STEPS = 16
"""Most steps of a chunk."""

Evaluate = Callable[[PyTree, PyTree, PyTree, PyTree], tuple[PyTree, PyTree]]
"""`evaluate(params, constants, carry, chunk)` returns the next carry and an output per step."""


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def over_chunks(
    evaluate: Evaluate,
    params: PyTree,
    constants: PyTree,
    carry: PyTree,
    steps: PyTree,
    longest: Int[Array, ""],
) -> PyTree:
    """Evaluate steps 0 to `longest`.

    Args:
        evaluate: Evaluates a chunk. It must not depend on other arrays than its arguments.
        params: Parameters, which have gradients.
        constants: Other arrays that `evaluate` needs. They have no gradients.
        carry: Carry before the first step.
        steps: Inputs with the axis of time first. They have no gradients.
        longest: Last step to evaluate.

    Returns:
        Floating-point outputs of all steps, 0 in the chunks after `longest`.
    """
    return _forward(evaluate, params, constants, carry, steps, longest)[0]


def _forward(evaluate, params, constants, carry, steps, longest):
    def run(carry, start):
        return evaluate(params, constants, carry, _chunk(steps, start))

    def skip(carry, start):
        shapes = jax.eval_shape(run, carry, start)[1]
        return carry, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def body(carry, start):
        after, outputs = jax.lax.cond(start <= longest, run, skip, carry, start)
        return after, (carry, outputs)

    _, (carries, chunks) = jax.lax.scan(body, carry, _starts(steps))
    outputs = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[: _length(steps)], chunks)
    return outputs, (params, constants, carries, steps, longest)


def _backward(evaluate, saved, gradients):
    params, constants, carries, steps, longest = saved

    def run(gradient, inputs):
        total, of_carry = gradient
        start, carry = inputs
        chunk, of_outputs = _chunk(steps, start), _chunk(gradients, start, "fill")
        backward = jax.vjp(lambda p, c: evaluate(p, constants, c, chunk), params, carry)[1]
        of_params, of_carry = backward((of_carry, of_outputs))
        return jax.tree.map(jnp.add, total, of_params), of_carry

    def body(gradient, inputs):
        evaluated = inputs[0] <= longest
        return jax.lax.cond(evaluated, run, lambda gradient, _: gradient, gradient, inputs), None

    first = jax.tree.map(lambda x: x[0], carries)
    zeros = jax.tree.map(jnp.zeros_like, (params, first))
    (of_params, of_carry), _ = jax.lax.scan(body, zeros, (_starts(steps), carries), reverse=True)
    return of_params, None, of_carry, None, None


over_chunks.defvjp(_forward, _backward)


def _length(steps: PyTree) -> int:
    return len(jax.tree.leaves(steps)[0])


def _size(steps: PyTree) -> int:
    """Return the length of a chunk. The last one has padding."""
    length = _length(steps)
    return -(-length // -(-length // CHUNK_STEPS))


def _starts(steps: PyTree) -> Int[Array, " chunks"]:
    return jnp.arange(0, _length(steps), _size(steps))


def _chunk(
    steps: PyTree, start: Int[Array, ""], padding: Literal["clip", "fill"] = "clip"
) -> PyTree:
    """Return the steps of a chunk. Padding repeats the last step, or is 0 with `fill`."""
    rows = start + jnp.arange(_size(steps))
    return jax.tree.map(lambda x: jnp.take(x, rows, 0, mode=padding, fill_value=0), steps)
