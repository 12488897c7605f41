"""The compiled functions of a run. All of them take a batch of seeds on the first axis."""

import gc
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from hmasd_jax import config as configs
from hmasd_jax.config import TrainConfig
from hmasd_jax.rl.evaluate import evaluate
from hmasd_jax.types import Algorithm, Key, Learner, Metrics

BatchLayout = Literal["vmap", "map", "sharded"]

EVALUATION = 2**31
"""Folded into the experiment's key, where training runs fold in their small index."""


class Advanced(NamedTuple):
    """What a number of updates brings."""

    states: Any
    sums: Metrics
    """Sums of every metric over the updates, (seeds,)."""
    healthy: Bool[Array, " seeds"]
    """Whether all parameters, optimizer states and metrics are finite."""


class Programs(NamedTuple):
    """Executables for a fixed number of seeds."""

    num_seeds: int
    init: Callable[[Key], Any]
    advance: Callable[[Any, Array], Advanced]
    """`advance(states, num_updates)`; `states` is donated."""
    evaluate: Callable[[Any, Key], Metrics]
    """`evaluate(states, keys)`: means over greedy episodes, (seeds,)."""
    memory_bytes: int
    """What the largest of them needs at once, by the compiler's own account."""
    compile_seconds: float


def seed_key(config: TrainConfig, index: int) -> Key:
    """Where training run `index` of an experiment begins."""
    return jax.random.fold_in(jax.random.key(config.seed), index)


def evaluation_key(config: TrainConfig, index: int, env_steps: int) -> Key:
    """Randomness of the evaluation of run `index` after `env_steps`."""
    key = jax.random.fold_in(jax.random.key(config.seed), EVALUATION + index)
    return jax.random.fold_in(key, env_steps)


def state_template(algorithm: Algorithm) -> Any:
    """Shapes of one seed's train state."""
    return jax.eval_shape(algorithm.init, jax.random.key(0))


def compile_programs(config: TrainConfig, num_seeds: int, layout: BatchLayout) -> Programs:
    """Build and compile everything that training `num_seeds` seeds at once runs.

    Args:
        config: the run.
        num_seeds: with `sharded`, a multiple of `jax.local_device_count()`.
        layout: how the seeds are batched.
    """
    start = time.perf_counter()
    env, algorithm = configs.build(config)
    update = jax.jit(algorithm.update)  # traced once although used twice below

    def advance(state: Any, num_updates: Array) -> Advanced:
        # A loop with a traced bound, so that one executable serves any number of updates.
        def body(_, carry):
            state, sums = carry
            state, metrics = update(state)
            return state, jax.tree.map(jnp.add, sums, metrics)

        shapes = jax.eval_shape(update, state)[1]
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        state, sums = jax.lax.fori_loop(0, num_updates, body, (state, zeros))
        return Advanced(state, sums, all_finite(state, sums))

    def play(state: Any, key: Key) -> Metrics:
        return evaluate(env, algorithm.policy(state, greedy=True), key, config.eval_episodes)

    keys = jax.random.split(jax.random.key(0), num_seeds)
    init_seeds = jax.jit(batched(algorithm.init, num_seeds, layout))
    states = jax.eval_shape(init_seeds, keys)
    count = jax.ShapeDtypeStruct((), jnp.int32)
    advance_seeds = jax.jit(batched(advance, num_seeds, layout, (0, None)), donate_argnums=0)
    evaluate_seeds = jax.jit(batched(play, num_seeds, layout, (0, 0)))
    programs = (
        build_executable(init_seeds, keys, runs_once=True),
        build_executable(advance_seeds, states, count),
        build_executable(evaluate_seeds, states, keys),
    )
    memory = max(_memory_bytes(program) for program in programs)
    return Programs(num_seeds, *programs, memory, time.perf_counter() - start)


def build_executable(
    function: jax.stages.Wrapped, *args: Any, runs_once: bool = False
) -> jax.stages.Compiled:
    """Trace and compile a jitted function, in little time where that does not make it slower.

    On a CPU at LLVM's first level of optimization instead of its last, which takes two thirds of
    the time for HMASD's `init`. What runs once is not optimized at all. The garbage that tracing
    leaves is collected afterwards: looking for it all the time takes a fourth of the tracing.
    """
    options: dict[str, str | bool] = {}
    if jax.default_backend() == "cpu" and not jax.config.read("jax_disable_most_optimizations"):
        options["xla_backend_optimization_level"] = "0" if runs_once else "1"
        options["xla_cpu_use_fusion_emitters"] = not runs_once
    collects = gc.isenabled()
    gc.disable()
    try:
        return function.lower(*args).compile(options)
    finally:
        if collects:
            gc.enable()


def all_finite(state: Any, metrics: Metrics) -> Bool[Array, ""]:
    """Whether every float of the learners in `state`, and of `metrics`, is finite."""
    nodes = jax.tree.leaves(state, is_leaf=lambda x: isinstance(x, Learner))
    learners = [node for node in nodes if isinstance(node, Learner)]
    floats = [
        x for x in jax.tree.leaves((learners, metrics)) if jnp.issubdtype(x.dtype, jnp.floating)
    ]
    return jnp.stack([jnp.isfinite(x).all() for x in floats]).all()


def batched(
    function: Callable,
    num_seeds: int,
    layout: BatchLayout = "vmap",
    in_axes: Sequence[int | None] = (0,),
) -> Callable:
    """`function` over a leading axis of seeds; arguments whose `in_axes` is None are shared.

    A single seed is not vmapped: on a CPU a batched matrix product is slower than a plain one.
    """
    in_axes = tuple(in_axes)
    if layout == "sharded":
        return _sharded(function, num_seeds, in_axes)
    if num_seeds > 1 and layout == "vmap":
        return jax.vmap(function, in_axes)

    def over_seeds(*args):
        def one(rows):
            chosen = zip(rows, args, in_axes)
            return function(*(arg if axis is None else row for row, arg, axis in chosen))

        rows = tuple(() if axis is None else arg for arg, axis in zip(args, in_axes))
        if num_seeds > 1:
            return jax.lax.map(one, rows)
        only = one(jax.tree.map(lambda x: x[0], rows))
        return jax.tree.map(lambda x: x[None], only)

    return over_seeds


def _sharded(function: Callable, num_seeds: int, in_axes: Sequence[int | None]) -> Callable:
    """An equal share of the seeds on each device of this process, none of them talking."""
    devices = jax.local_devices()
    mesh = jax.sharding.Mesh(devices, ("seeds",))
    by_seed, shared = jax.P("seeds"), jax.P()
    inner: BatchLayout = "map" if devices[0].platform == "cpu" else "vmap"
    return jax.shard_map(
        batched(function, num_seeds // len(devices), inner, in_axes),
        mesh=mesh,
        in_specs=tuple(shared if axis is None else by_seed for axis in in_axes),
        out_specs=by_seed,
        check_vma=False,
    )


def _memory_bytes(program: Any) -> int:
    """Arguments, results and temporaries of an executable; 0 if the backend does not tell."""
    analysis = program.memory_analysis()
    if analysis is None:
        return 0
    return (
        analysis.argument_size_in_bytes
        + analysis.output_size_in_bytes
        - analysis.alias_size_in_bytes
        + analysis.temp_size_in_bytes
    )
