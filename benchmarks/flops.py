"""Floating point operations of matrix products: those of a function, and the machine's rate."""

import math
from collections.abc import Callable
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr

from benchmarks.measure import measure

ROWS, WIDTH = 9600, 64
"""Rows of a batch and width of a layer in training at the paper's sizes."""


def matmul_flops(function: Callable, *args: Any) -> float:
    """Count multiplications and additions in the matrix products of `function(*args)`.

    The body of a loop counts once per round, or once if the number of rounds depends on data. A
    conditional counts as its cheapest branch: HMASD assigns skills in a conditional, which rarely
    takes the expensive branch.
    """
    return _flops(jax.make_jaxpr(function)(*args).jaxpr)


def _flops(jaxpr: Jaxpr) -> float:
    total = 0.0
    for equation in jaxpr.eqns:
        params = equation.params
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = params["dimension_numbers"]
            shape = equation.invars[0].aval.shape
            depth = math.prod(shape[axis] for axis in contracted)
            total += 2.0 * depth * math.prod(equation.outvars[0].aval.shape)
            continue
        inner = [_flops(sub) for value in params.values() for sub in _jaxprs(value)]
        if equation.primitive.name == "cond":
            total += min(inner, default=0.0)
        else:
            total += params.get("length", 1) * sum(inner)
    return total


def _jaxprs(value: Any) -> list[Jaxpr]:
    """Return the programs in a parameter of an equation."""
    if isinstance(value, ClosedJaxpr):
        return [value.jaxpr]
    if isinstance(value, Jaxpr):
        return [value]
    if isinstance(value, tuple | list):
        return [jaxpr for item in value for jaxpr in _jaxprs(item)]
    return []


def ceiling_gflops(repeats: int) -> float:
    """Measure GFLOP per CPU-second of a layer's products: forward, and gradients of x and W."""
    key_x, key_w, key_y = jax.random.split(jax.random.key(0), 3)
    x = jax.random.normal(key_x, (ROWS, WIDTH))
    w = jax.random.normal(key_w, (WIDTH, WIDTH))
    y = jax.random.normal(key_y, (ROWS, WIDTH))
    products: list[tuple[Callable, tuple]] = [
        (lambda x, w: x @ w, (x, w)),
        (lambda y, w: y @ w.T, (y, w)),
        (lambda x, y: x.T @ y, (x, y)),
    ]
    flops = 2.0 * ROWS * WIDTH * WIDTH
    seconds = sum(_seconds(product, args, repeats) for product, args in products)
    return len(products) * flops / seconds / 1e9


def _seconds(product: Callable, args: tuple, repeats: int) -> float:
    """Measure the CPU-seconds of one product."""
    calls = 100  # timed together, because a clock cannot resolve a single product
    program = jax.jit(product)
    return measure(lambda: [program(*args) for _ in range(calls)], repeats).cpu / calls
