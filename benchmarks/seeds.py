"""Measure throughput against the number of seeds, for each placement of a sweep.

python benchmarks/seeds.py [--seeds 1 2 4] [--placement workers vmap map sharded] [--json]

On a CPU, one seed in the placement `workers` is pinned to one core; its row is the reference for
the others. The placement `sharded` treats each core as a device.
"""

import math
import multiprocessing
import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax

from benchmarks.measure import (
    Row,
    Timing,
    compiled,
    isolated,
    measure,
    peak_rss_mb,
    report,
    training_parser,
)
from benchmarks.training import preset
from hmasd_jax import config as configs
from hmasd_jax.runs import folder as run_folder
from hmasd_jax.training.compiled import BatchPlacement, batched

PLACEMENTS = ("workers", "vmap", "map", "sharded")
COMPILES_WITHIN = 900
"""Time after which workers no longer wait for one that has failed (seconds)."""


def in_one_program(
    config: Any, seeds: int, placement: BatchPlacement, devices: int, repeats: int
) -> Row:
    """Measure an update of all seeds in one process and one program."""
    if placement == "sharded":
        flags = os.environ.get("XLA_FLAGS", "")
        os.environ["XLA_FLAGS"] = f"{flags} --xla_force_host_platform_device_count={devices}"
    _, learner = configs.build(config)
    keys = jax.random.split(jax.random.key(0), seeds)
    states = jax.jit(batched(learner.init, seeds, placement))(keys)
    update, compile_s = compiled(batched(learner.update, seeds, placement), states)
    timing = measure(lambda: update(states), repeats)
    return _row(config, seeds, placement, timing, compile_s, peak_rss_mb())


def with_workers(config: Any, seeds: int, cores: list[int], repeats: int) -> Row:
    """Measure an update of all seeds with a process per core, which trains its share in turn."""
    cores = cores[:seeds]
    shares = [len(range(worker, seeds, len(cores))) for worker in range(len(cores))]
    barrier = multiprocessing.get_context("spawn").Barrier(len(cores))

    def run(core: int, share: int) -> tuple[Timing, float, float]:
        return isolated(_work, config, share, repeats, barrier, core=core)

    with ThreadPoolExecutor(len(cores)) as pool:
        timings, compile_s, peaks = zip(*pool.map(run, cores, shares))
    total = Timing(
        max(timing.wall for timing in timings),
        sum(timing.cpu for timing in timings),
        max(timing.spread for timing in timings),
    )
    return _row(config, seeds, "workers", total, max(compile_s), sum(peaks))


def _work(config: Any, seeds: int, repeats: int, barrier: Any) -> tuple[Timing, float, float]:
    _, learner = configs.build(config)
    state = jax.jit(learner.init)(jax.random.key(0))
    update, compile_s = compiled(learner.update, state)
    barrier.wait(COMPILES_WITHIN)  # no process is timed while another one still compiles

    def one_after_the_other() -> None:
        for _ in range(seeds):
            jax.block_until_ready(update(state))

    return measure(one_after_the_other, repeats), compile_s, peak_rss_mb()


def _row(config, seeds, placement, timing, compile_s, peak) -> Row:
    names = configs.to_json(config)
    return Row(
        f"{seeds} seeds, {placement}",
        names["env"]["name"],
        names["algorithm"]["name"],
        seeds,
        placement,
        **timing.rates(seeds * config.env_steps_per_update),
        compile_s=compile_s,
        peak_rss_mb=peak,
    )


def main() -> None:
    """Run the benchmark from the command line."""
    options = training_parser(__doc__)
    options.add_argument("--seeds", type=int, nargs="+", help="numbers of seeds to train at once")
    options.add_argument(
        "--placement", nargs="+", choices=PLACEMENTS, help="default: all that apply"
    )
    args = options.parse_args()
    _, config = preset(args.env, args.algorithm, args.quick)
    cores = run_folder.available_cores()
    on_cpu = jax.default_backend() == "cpu"
    devices = len(cores) if on_cpu else jax.local_device_count()
    placements = args.placement or [name for name in PLACEMENTS if on_cpu or name != "workers"]
    counts = args.seeds or ([2] if args.quick else [1, 2, 4] if on_cpu else [1, 4, 16, 64])

    def rows():
        for placement in placements:
            for seeds in counts:
                if placement == "workers":
                    yield with_workers(config, seeds, cores, args.repeats)
                    continue
                if placement == "sharded":
                    seeds = math.ceil(seeds / devices) * devices
                yield isolated(in_one_program, config, seeds, placement, devices, args.repeats)

    report(rows(), args.json)


if __name__ == "__main__":
    main()
