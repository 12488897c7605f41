"""Common parts of the benchmarks: clocks, processes of their own, and rows of results."""

import argparse
import dataclasses
import json
import multiprocessing
import os
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
from rich.console import Console
from rich.table import Table

from envs_jax.registry import ENVIRONMENTS
from hmasd_jax.algorithms import ALGORITHMS
from hmasd_jax.runs import folder as run_folder
from hmasd_jax.training.compiled import Runs, build_executable
from hmasd_jax.training.workers import pin

ABOUT = ("cpu", "cores", "device", "jax", "python", "commit")
"""Entries of `run_folder.describe` that a table shows."""
ON_POLICY = [
    name
    for name, entry in ALGORITHMS.items()
    if "ppo" in {field.name for field in dataclasses.fields(entry.config)}
]
"""Algorithms whose updates are all the same work. Those with a replay must fill it first."""


@dataclass(frozen=True)
class Row:
    """One measurement; fields that do not apply are None."""

    name: str
    env: str | None = None
    algorithm: str | None = None
    seeds: int | None = None
    placement: str | None = None
    env_steps_per_s: float | None = None
    env_steps_per_cpu_s: float | None = None
    gflops: float | None = None
    """Floating point operations of matrix products, 1e9 per CPU-second."""
    ceiling_gflops: float | None = None
    """Rate of small matrix products alone on the same cores, measured in the same process."""
    compile_s: float | None = None
    peak_rss_mb: float | None = None
    spread: float | None = None
    """(slowest - fastest) / median of the repeats."""
    ratio: float | None = None
    """Work per CPU-second relative to the reference."""
    ratio_interval: tuple[float, float] | None = None
    """95 % bootstrap interval of `ratio` over the repeats."""


class Timing(NamedTuple):
    """Medians over repeats, in seconds."""

    wall: float
    cpu: float
    spread: float

    def rates(self, env_steps: float) -> dict[str, float]:
        """Return the columns of a `Row` for a call that makes `env_steps` environment steps."""
        return {
            "env_steps_per_s": env_steps / self.wall,
            "env_steps_per_cpu_s": env_steps / self.cpu,
            "spread": self.spread,
        }


def measure(run: Callable[[], Any], repeats: int) -> Timing:
    """Time `run`, its result included, after one call that does not count."""
    return alternate({"": run}, repeats)[""]


def alternate(runs: dict[str, Callable[[], Any]], repeats: int) -> dict[str, Timing]:
    """Time all of `runs` in turn, `repeats` times, after one call of each that does not count."""
    clocks: dict[str, list[tuple[float, float]]] = {name: [] for name in runs}
    for run in runs.values():
        jax.block_until_ready(run())
    for _ in range(repeats):
        for name, run in runs.items():
            wall, cpu = time.perf_counter(), time.process_time()
            jax.block_until_ready(run())
            clocks[name].append((time.perf_counter() - wall, time.process_time() - cpu))
    return {name: _timing(*zip(*seconds)) for name, seconds in clocks.items()}


def _timing(walls: tuple[float, ...], cpus: tuple[float, ...]) -> Timing:
    median = statistics.median(walls)
    return Timing(median, statistics.median(cpus), (max(walls) - min(walls)) / median)


def compiled(function: Callable, *args: Any, runs: Runs = "often") -> tuple[Callable, float]:
    """Compile as the trainer does; return the executable and the seconds to trace and compile."""
    start = time.perf_counter()
    executable = build_executable(jax.jit(function), *args, runs=runs)
    return executable, time.perf_counter() - start


def jitted(function: Callable, *args: Any) -> tuple[Callable, float]:
    """Compile with JAX's own settings; return the executable and the seconds, as `compiled`."""
    start = time.perf_counter()
    return jax.jit(function).lower(*args).compile(), time.perf_counter() - start


def peak_rss_mb() -> float:
    """Return the largest resident memory that this process has had, in MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def isolated(function: Callable[..., Any], *args: Any, core: int | None = None) -> Any:
    """Return `function(*args)`, computed in a fresh process with its own memory and threads.

    Args:
        function: a function at the top level of a module, so that it can be pickled.
        args: arguments that can be pickled.
        core: processor core to use, with one thread; None uses all cores.

    Raises:
        RuntimeError: the process failed; its error message is on standard error.
    """
    context = multiprocessing.get_context("spawn")
    pipe, other = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(other, core, function, args))
    process.start()
    other.close()
    try:
        return pipe.recv()
    except EOFError as error:
        raise RuntimeError(f"{function.__name__}{args} failed: see the error above") from error
    finally:
        process.join()


def _answer(pipe, core, function, args) -> None:
    os.dup2(2, 1)  # standard output is for rows alone, so libraries print to standard error
    if core is not None:
        pin(core)
    pipe.send(function(*args))


def parser(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options of all benchmarks."""
    parser = argparse.ArgumentParser(description=(description or "").splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5, help="repeats (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object per row")
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to see that it runs")
    return parser


def training_parser(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options of all benchmarks, and those of what to train."""
    options = parser(description)
    options.add_argument(
        "--env", default="alice_and_bob", choices=ENVIRONMENTS, help="default: %(default)s"
    )
    options.add_argument(
        "--algorithm", default="hmasd", choices=ON_POLICY, help="default: %(default)s"
    )
    return options


def report(rows: Iterable[Row], as_json: bool) -> None:
    """Print each row as JSON as soon as it is measured, or all as one table under a heading.

    The heading names the machine, and the values that all rows share.
    """
    if as_json:
        for row in rows:
            print(json.dumps(dataclasses.asdict(row)), flush=True)
        return
    rows = list(rows)
    about = run_folder.describe([])
    columns = {f.name: [getattr(row, f.name) for row in rows] for f in dataclasses.fields(Row)}
    shared = {name: values[0] for name, values in columns.items() if len({*values}) == 1}
    heading = [f"{name} {about[name]}" for name in ABOUT]
    heading += [f"{name} {text(value)}" for name, value in shared.items() if value is not None]
    console = Console(width=140, highlight=False)
    console.print(", ".join(heading), markup=False)
    varying = [name for name in columns if name not in shared]
    table = Table(*(name.replace("_", " ") for name in varying))
    for row in rows:
        table.add_row(*(text(getattr(row, name)) for name in varying))
    console.print(table)


def text(value: Any) -> str:
    """Format a value for a table."""
    if value is None:
        return ""
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(text, value))}]"
    if not isinstance(value, float):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
