"""Measure environment steps per second of whole updates on one core, and of their parts.

python benchmarks/training.py [--env alice_and_bob] [--algorithm hmasd] [--json]

The first two rows are compiled on all cores, as in a run that has them. All other rows are compiled
and run on one core. The row `update` is one update at the paper's settings. For HMASD its parts
follow, each computed alone. GFLOP count matrix products only.
"""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from typing import Any

import jax

from benchmarks.flops import ceiling_gflops, matmul_flops
from benchmarks.measure import (
    Row,
    compiled,
    isolated,
    measure,
    peak_rss_mb,
    report,
    training_parser,
)
from hmasd_jax import config as configs
from hmasd_jax.hmasd import algorithm as hmasd
from hmasd_jax.hmasd.batches import high_batch, low_batch, skill_pairs
from hmasd_jax.hmasd.components import make_parts
from hmasd_jax.hmasd.rollout_phase import collect
from hmasd_jax.rl import rollout as rollouts
from hmasd_jax.runs import folder as run_folder

QUICK = {"algorithm.ppo.num_envs": 2, "algorithm.ppo.num_epochs": 1}


def preset(env: str, algorithm: str, quick: bool) -> tuple[dict[str, Any], configs.TrainConfig]:
    """Return the paper's settings of `algorithm` on `env`, or a tiny version if `quick`.

    Returns:
        Values by dotted name that differ from the defaults, and the whole configuration.
    """
    overrides = {"env.name": env, "algorithm.name": algorithm} | (QUICK if quick else {})
    return overrides, configs.load(overrides=overrides)


def hmasd_parts(config: configs.TrainConfig) -> Iterator[tuple[str, Callable, tuple]]:
    """Yield name, function and arguments of each part of an update, on data of a rollout."""
    parts = make_parts(config.env, config.algorithm)
    key = jax.random.key(0)
    state = jax.jit(lambda key: hmasd.init_state(parts, key))(key)
    networks = state.coordinator.params, state.discoverer.params

    def rollout(networks, env, memory, key):
        coordinator, discoverer = networks
        return collect(parts, coordinator, discoverer, env, memory, key)

    yield "rollout", rollout, (networks, state.env, state.memory, key)
    data = jax.jit(rollout)(networks, state.env, state.memory, key)
    reward = data.transitions.outcome.reward[..., None] + jax.numpy.zeros(config.env.num_agents)
    phases = {
        "coordinator": (
            hmasd.train_coordinator,
            jax.jit(partial(high_batch, parts))(networks[0], state.coordinator_norm, data, key),
        ),
        "discoverer": (
            hmasd.train_discoverer,
            jax.jit(partial(low_batch, parts))(networks[1], state.discoverer_norm, data, reward),
        ),
        "discriminators": (
            hmasd.train_discriminators,
            jax.jit(lambda data: rollouts.flatten(skill_pairs(parts, data)))(data),
        ),
    }
    for name, (train, batch) in phases.items():
        yield name, lambda *args, train=train: train(parts, *args), (state, batch, key)


PARTS = {"hmasd": hmasd_parts}


def bench(env: str, algorithm: str, quick: bool, repeats: int) -> list[Row]:
    """Measure the update and its parts in this process."""
    _, config = preset(env, algorithm, quick)
    env_steps = config.env_steps_per_update
    _, learner = configs.build(config)
    init, init_s = compiled(learner.init, jax.random.key(0), runs="once")
    state = init(jax.random.key(0))
    rows = [Row("init", env, algorithm, seeds=1, compile_s=init_s, peak_rss_mb=peak_rss_mb())]
    ceiling = ceiling_gflops(repeats)
    work = [("update", learner.update, (state,))]
    for name, function, args in chain(work, PARTS.get(algorithm, lambda _: ())(config)):
        function = jax.jit(function)  # traced once although used twice below
        program, compile_s = compiled(function, *args)
        timing = measure(lambda program=program, args=args: program(*args), repeats)
        rows.append(
            Row(
                name,
                env,
                algorithm,
                seeds=1,
                **timing.rates(env_steps),
                gflops=matmul_flops(function, *args) / timing.cpu / 1e9,
                ceiling_gflops=ceiling,
                compile_s=compile_s,
                peak_rss_mb=peak_rss_mb(),
            )
        )
    return rows


def bench_compilation(env: str, algorithm: str, quick: bool) -> list[Row]:
    """Measure compilation in this process, without running anything."""
    _, learner = configs.build(preset(env, algorithm, quick)[1])
    key = jax.random.key(0)
    _, init_s = compiled(learner.init, key, runs="once")
    _, update_s = compiled(learner.update, jax.eval_shape(learner.init, key))
    seconds = {"init": init_s, "update": update_s}
    return [
        Row(f"{name}, all cores", env, algorithm, seeds=1, compile_s=compile_s)
        for name, compile_s in seconds.items()
    ]


def main() -> None:
    """Run the benchmark from the command line."""
    args = training_parser(__doc__).parse_args()
    core = run_folder.available_cores()[0]
    rows = isolated(bench_compilation, args.env, args.algorithm, args.quick)
    rows += isolated(bench, args.env, args.algorithm, args.quick, args.repeats, core=core)
    report(rows, args.json)


if __name__ == "__main__":
    main()
