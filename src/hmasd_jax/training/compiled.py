"""The compiled functions of a run. All of them take a batch of seeds on the first axis."""

import functools
import gc
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from envs_jax import Environment
from hmasd_jax.config import TrainConfig
from hmasd_jax.rl.evaluate import evaluate
from hmasd_jax.training.executable_cache import load_or_compile
from hmasd_jax.types import Algorithm, Key, Learner, Metrics

BatchPlacement = Literal["vmap", "map", "sharded"]

Runs = Literal["once", "seldom", "often"]
"""Frequency of a program's runs, which decides how much to optimize it."""

RUNS: tuple[Runs, ...] = ("once", "often", "seldom")
"""Frequencies of `init`, `advance` and `evaluate`."""

EVALUATION = 2**31
"""Number folded into the experiment's key for evaluations. For training it is the index of a seed,
which is smaller."""


class Advanced(NamedTuple):
    """Result of a number of updates."""

    states: Any
    """Train states after the updates, with the seeds on the first axis."""
    sums: Metrics
    """Sum of every metric over the updates, (seeds,)."""
    healthy: Bool[Array, " seeds"]
    """True if all parameters, optimizer states and metrics are finite, (seeds,)."""


class Programs(NamedTuple):
    """Executables for a fixed number of seeds."""

    num_seeds: int
    """Size of the first axis of all arguments and results."""
    init: Callable[[Key], Any]
    """`init(keys)` returns the initial train states."""
    advance: Callable[[Any, Array], Advanced]
    """`advance(states, num_updates)` runs updates; `states` is donated."""
    evaluate: Callable[[Any, Key], Metrics]
    """`evaluate(states, keys)` returns means over greedy episodes, (seeds,)."""
    memory_bytes: int
    """Memory that the largest program needs, as the compiler predicts."""
    compile_seconds: float
    """Wall time of building and compiling all of them."""


def seed_key(config: TrainConfig, index: int) -> Key:
    """Return the key that training run `index` of an experiment starts from."""
    return jax.random.fold_in(jax.random.key(config.seed), index)


def evaluation_key(config: TrainConfig, index: int, env_steps: int) -> Key:
    """Return the key for the evaluation of run `index` after `env_steps`."""
    key = jax.random.fold_in(jax.random.key(config.seed), EVALUATION + index)
    high, low = divmod(env_steps, 2**32)  # `fold_in` takes 32 bits.
    key = jax.random.fold_in(key, low)
    return jax.random.fold_in(key, high) if high else key


def compile_programs(
    env: Environment,
    algorithm: Algorithm,
    eval_episodes: int,
    num_seeds: int,
    placement: BatchPlacement,
) -> Programs:
    """Compile all programs that train `num_seeds` seeds at once.

    Args:
        env: Environment for the evaluations.
        algorithm: Algorithm to train.
        eval_episodes: Episodes per evaluation and seed.
        num_seeds: Number of seeds. For `sharded`, a multiple of `jax.local_device_count()`.
        placement: Placement of the seeds: all at once (`vmap`), one after the other (`map`), or
            over all devices of this process (`sharded`).
    """
    start = time.perf_counter()
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
        return Advanced(states=state, sums=sums, healthy=all_finite(state, sums))

    def play(state: Any, key: Key) -> Metrics:
        return evaluate(env, algorithm.policy(state, greedy=True), key, eval_episodes)

    keys = jax.random.split(jax.random.key(0), num_seeds)
    init_seeds = jax.jit(batched(algorithm.init, num_seeds, placement))
    states = jax.eval_shape(init_seeds, keys)
    count = jax.ShapeDtypeStruct((), jnp.int32)
    advance_seeds = jax.jit(batched(advance, num_seeds, placement, (0, None)), donate_argnums=0)
    evaluate_seeds = jax.jit(batched(play, num_seeds, placement, (0, 0)))
    lowered = (
        lower(init_seeds, keys),
        lower(advance_seeds, states, count),
        lower(evaluate_seeds, states, keys),
    )
    programs = load_or_compile(
        lowered,
        lambda: _compile_together(lowered),
        lambda programs: _first_update(keys, *programs),
    )
    init, advance_by, evaluate_at = programs
    return Programs(
        num_seeds=num_seeds,
        init=init,
        advance=advance_by,
        evaluate=evaluate_at,
        memory_bytes=max(_memory_bytes(program) for program in programs),
        compile_seconds=time.perf_counter() - start,
    )


def _compile_together(lowered: Sequence[jax.stages.Lowered]) -> tuple[jax.stages.Compiled, ...]:
    """Compile `init`, `advance` and `evaluate` at once.

    Most of XLA's passes over a program use one core, which leaves others for the next program.
    """
    with ThreadPoolExecutor() as pool:
        return tuple(pool.map(compile_lowered, lowered, RUNS))


def _first_update(keys: Key, init: Callable, advance: Callable, evaluate: Callable) -> Any:
    """Return what the programs of a run compute in the first update of some seeds."""
    advanced = advance(init(keys), jnp.int32(1))
    leaves = jax.tree.leaves((advanced, evaluate(advanced.states, keys)))
    return [x for x in leaves if not jnp.issubdtype(x.dtype, jax.dtypes.prng_key)]


def build_executable(
    function: jax.stages.Wrapped, *args: Any, runs: Runs = "often"
) -> jax.stages.Compiled:
    """Trace and compile a jitted function with options that save compile time.

    Args:
        function: Jitted function.
        *args: Arguments, or their shapes and dtypes.
        runs: Frequency of the runs.
    """
    return compile_lowered(lower(function, *args), runs)


def lower(function: jax.stages.Wrapped, *args: Any) -> jax.stages.Lowered:
    """Trace a jitted function.

    Garbage is collected afterwards, because the collector would otherwise take a fourth of the
    time.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        return function.lower(*args)
    finally:
        if collects:
            gc.enable()


def compile_lowered(lowered: jax.stages.Lowered, runs: Runs = "often") -> jax.stages.Compiled:
    """Compile a traced function.

    On a CPU, programs are compiled at LLVM's first level of optimization, or at none if they run
    once. HMASD runs as fast as at the last level, and its `init` compiles in two thirds of the
    time. The older emitters of fused kernels compile sooner to slower programs, which saves time
    where evaluations are seldom. jax 0.11.1 and later no longer have them.

    Args:
        lowered: Traced function.
        runs: Frequency of the runs.
    """
    options: dict[str, str | bool] = {}
    if jax.default_backend() == "cpu" and not jax.config.read("jax_disable_most_optimizations"):
        options["xla_backend_optimization_level"] = "0" if runs == "once" else "1"
        if has_older_emitters():
            options["xla_cpu_use_fusion_emitters"] = runs == "often"
    return lowered.compile(options)


@functools.cache
def has_older_emitters() -> bool:
    """Return True if this version of XLA still has its older emitters of fused kernels."""
    try:
        jax.jit(lambda: 0).lower().compile({"xla_cpu_use_fusion_emitters": False})
    except jax.errors.JaxRuntimeError:
        return False
    return True


def all_finite(state: Any, metrics: Metrics) -> Bool[Array, ""]:
    """Return True if every float in the learners of `state` and in `metrics` is finite."""
    nodes = jax.tree.leaves(state, is_leaf=lambda x: isinstance(x, Learner))
    learners = [node for node in nodes if isinstance(node, Learner)]
    floats = [
        x for x in jax.tree.leaves((learners, metrics)) if jnp.issubdtype(x.dtype, jnp.floating)
    ]
    # One check of one vector compiles sooner than a check of each array.
    return jnp.isfinite(jnp.concatenate([x.ravel() for x in floats])).all()


def batched(
    function: Callable,
    num_seeds: int,
    placement: BatchPlacement = "vmap",
    in_axes: Sequence[int | None] = (0,),
) -> Callable:
    """Map `function` over a leading axis of seeds.

    A single seed is not vmapped, because a batched matrix product is slower than a plain one on a
    CPU.

    Args:
        function: Function of one seed.
        num_seeds: Size of the leading axis.
        placement: Placement of the seeds.
        in_axes: 0 for each argument with an axis of seeds, None for each that all seeds share.
    """
    in_axes = tuple(in_axes)
    if placement == "sharded":
        return _sharded(function, num_seeds, in_axes)
    if num_seeds > 1 and placement == "vmap":
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
    """Map over equal shares of the seeds, one per device of this process.

    The devices do not communicate.
    """
    devices = jax.local_devices()
    mesh = jax.sharding.Mesh(devices, ("seeds",))
    by_seed, shared = jax.P("seeds"), jax.P()
    inner: BatchPlacement = "map" if devices[0].platform == "cpu" else "vmap"
    return jax.shard_map(
        batched(function, num_seeds // len(devices), inner, in_axes),
        mesh=mesh,
        in_specs=tuple(shared if axis is None else by_seed for axis in in_axes),
        out_specs=by_seed,
        check_vma=False,
    )


def _memory_bytes(program: Any) -> int:
    """Return the size of arguments, results and temporaries; 0 if the backend does not tell."""
    analysis = program.memory_analysis()
    if analysis is None:
        return 0
    return (
        analysis.argument_size_in_bytes
        + analysis.output_size_in_bytes
        - analysis.alias_size_in_bytes
        + analysis.temp_size_in_bytes
    )
