"""What the benchmarks share: clocks, processes of their own, and rows of results."""

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

from hmasd_jax.runs import folder as run_folder
from hmasd_jax.training import compiled as programs
from hmasd_jax.training import workers as sweep

ABOUT = ("cpu", "cores", "device", "jax", "python", "commit")
"""What a table says of the machine, of all that `run_folder.describe` knows."""


@dataclass(frozen=True)
class Row:
    """One measurement; None is what does not apply."""

    name: str
    env: str | None = None
    algorithm: str | None = None
    seeds: int | None = None
    layout: str | None = None
    env_steps_per_s: float | None = None
    env_steps_per_cpu_s: float | None = None
    gflops: float | None = None
    """Matrix products only, per second of processor time."""
    ceiling_gflops: float | None = None
    """What small matrix products alone reach on the same cores, measured in the same process."""
    compile_s: float | None = None
    peak_rss_mb: float | None = None
    spread: float | None = None
    """(slowest - fastest) / median of the repeats."""


class Timing(NamedTuple):
    """Medians over repeats, in seconds."""

    wall: float
    cpu: float
    spread: float

    def rates(self, env_steps: float) -> dict[str, float]:
        """The columns of a row that follow for so many environment steps."""
        return {
            "env_steps_per_s": env_steps / self.wall,
            "env_steps_per_cpu_s": env_steps / self.cpu,
            "spread": self.spread,
        }


def measure(run: Callable[[], Any], repeats: int) -> Timing:
    """Time `run` after one call that does not count; its result is waited for."""
    return alternate({"": run}, repeats)[""]


def alternate(runs: dict[str, Callable[[], Any]], repeats: int) -> dict[str, Timing]:
    """Time all of `runs` in turn, `repeats` times over, as `measure` does."""
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


def compiled(function: Callable, *args: Any, runs_once: bool = False) -> tuple[Callable, float]:
    """The executable that the trainer would use, and the seconds to trace and compile it."""
    start = time.perf_counter()
    executable = programs.build_executable(jax.jit(function), *args, runs_once=runs_once)
    return executable, time.perf_counter() - start


def jitted(function: Callable, *args: Any) -> tuple[Callable, float]:
    """The same with JAX's own settings, as everybody else's code is compiled."""
    start = time.perf_counter()
    return jax.jit(function).lower(*args).compile(), time.perf_counter() - start


def peak_rss_mb() -> float:
    """The largest memory that this process has ever held."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def isolated(function: Callable[..., Any], *args: Any, core: int | None = None) -> Any:
    """`function(*args)` in a fresh process, for memory and threads of its own.

    Args:
        function: of a module, so that it can be found again.
        args: what can be pickled.
        core: the processor core to stay on, in one thread; all cores if None.

    Raises:
        RuntimeError: the process failed; it has told why.
    """
    context = multiprocessing.get_context("spawn")
    pipe, other = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(other, core, function, args))
    process.start()
    other.close()
    try:
        return pipe.recv()
    except EOFError as error:
        raise RuntimeError(f"{function.__name__}{args} failed") from error
    finally:
        process.join()


def _answer(pipe, core, function, args) -> None:
    os.dup2(2, 1)  # whatever a library prints is not a result
    if core is not None:
        sweep.pin(core)
    pipe.send(function(*args))


def parser(description: str | None) -> argparse.ArgumentParser:
    """The options that all benchmarks have."""
    parser = argparse.ArgumentParser(description=(description or "").splitlines()[0])
    parser.add_argument("--env", default="alice_and_bob", help="environment (default: %(default)s)")
    parser.add_argument("--algorithm", default="hmasd", help="algorithm (default: %(default)s)")
    parser.add_argument("--seeds", type=int, nargs="+", help="numbers of seeds to train at once")
    parser.add_argument("--layout", nargs="+", help="layouts of seeds")
    parser.add_argument("--repeats", type=int, default=5, help="repeats (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object per row")
    parser.add_argument("--quick", action="store_true", help="tiny sizes: only whether it runs")
    return parser


def report(rows: Iterable[Row], as_json: bool) -> None:
    """Print rows: as JSON as they come, or as one table under what they were measured on."""
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
    """A value in a table."""
    if value is None:
        return ""
    if not isinstance(value, float):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
