"""Core-minutes and environment steps until a seed reaches 90 % of its final level.

python benchmarks/time_to_solve.py                # every recorded result of results/
python benchmarks/time_to_solve.py RUN...         # run folders, finished or still training
python benchmarks/time_to_solve.py --live CONFIG  # trains this configuration now, then measures it

The final level of a seed is the mean of its last five evaluations. It is reached at the first
evaluation of at least 90 % of it. Seeds with a final level of less than a tenth of the best seed's
have not learned and only count as such. Time is that of training and evaluation, without
compilation; a worker of a sweep uses one core. Recorded results keep only the time of whole seeds,
so that there the time is in proportion to the environment steps.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from statistics import fmean, median
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from benchmarks.measure import text
from hmasd_jax.analysis.learning import LAST, main_metric
from hmasd_jax.runs import metrics_log
from hmasd_jax.runs.folder import RunError, metrics_path, seeds_of

ROOT = Path(__file__).parents[1]
SHARE = 0.9
"""Part of the final level to reach."""
LEARNED = 0.1
"""Part of the best seed's final level below which a seed has not learned."""
LEAST = 0.05
"""Success rate or return below which no seed has learned, so that the best may have not, either."""


class Curve(NamedTuple):
    """Evaluations of one seed, without that of the untrained policy."""

    env_steps: list[int]
    values: list[float]
    seconds: list[float]
    """Seconds of training until each evaluation, on one core."""


class Row(NamedTuple):
    """Medians over the seeds that learned; None if none did."""

    name: str
    seeds: int
    learned: int
    level: float | None
    """Final level: success rate or return."""
    env_steps: float | None
    """Environment steps until `SHARE` of it."""
    core_minutes: float | None
    slowest_core_minutes: float | None
    """Core-minutes of the slowest seed that learned."""


def solve(name: str, curves: list[Curve]) -> Row:
    """Return the row of several seeds."""
    levels = [fmean(curve.values[-LAST:]) for curve in curves]
    learned = [
        (curve, level)
        for curve, level, has_learned in zip(curves, levels, have_learned(levels))
        if has_learned
    ]
    if not learned:
        return Row(name, len(curves), 0, None, None, None, None)
    at = [first_at_least(curve.values, SHARE * level) for curve, level in learned]
    steps = [curve.env_steps[i] for i, (curve, _) in zip(at, learned)]
    minutes = [curve.seconds[i] / 60 for i, (curve, _) in zip(at, learned)]
    level = median(level for _, level in learned)
    return Row(
        name, len(curves), len(learned), level, float(median(steps)), median(minutes), max(minutes)
    )


def have_learned(levels: Sequence[float]) -> list[bool]:
    """Return which seeds have learned, from the final level of each."""
    return [level >= max(LEARNED * max(levels), LEAST) for level in levels]


def first_at_least(values: list[float], bound: float) -> int:
    """Return the index of the first value that is at least `bound`."""
    return next(i for i, value in enumerate(values) if value >= bound)


def recorded() -> Iterator[Row]:
    """Yield a row for every recorded result whose seeds trained on one core each."""
    for path in sorted((ROOT / "results").glob("**/*.json")):
        record = json.loads(path.read_text())
        if "tried" in path.parts or not {"values", "wall_seconds"} <= set(record):
            continue
        devices = record.get("devices", [record["device"]])
        if not all(device.startswith("cpu") for device in devices):  # Not a core for each seed.
            continue
        steps = record["env_steps"]
        curves = [
            Curve(steps[1:], values[1:], [seconds * step / steps[-1] for step in steps[1:]])
            for values, seconds in zip(record["values"], record["wall_seconds"])
        ]
        yield solve(path.relative_to(ROOT / "results").with_suffix("").as_posix(), curves)


def measured(run: Path) -> Row:
    """Return the row of a run folder.

    Raises:
        RunError: No seed of the run has an evaluation.
    """
    curves = []
    for seed in seeds_of(run):
        records = metrics_log.evaluations(metrics_log.read(metrics_path(run, seed)))
        if records:
            names = ("env_steps", main_metric(records[-1]), "wall_seconds")
            curves.append(Curve(*([record[name] for record in records] for name in names)))
    if not curves:
        raise RunError(f"{run} has no evaluation yet: wait for its first one")
    return solve(run.name, curves)


def train(config: Path) -> Row:
    """Train a configuration on the workers of a sweep, and return its row."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / config.stem
        words = ["seed_sweep", "--config", str(config), "--placement", "workers"]
        command = [sys.executable, "-m", "hmasd_jax.train", *words, "--run-dir", str(run)]
        subprocess.run(command, check=True, stdout=sys.stderr)
        return measured(run)


def main() -> None:
    """Print one row per result, run or configuration."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN", help="folders of runs")
    parser.add_argument("--live", type=Path, metavar="CONFIG", help="configuration to train")
    parser.add_argument("--json", action="store_true", help="print one JSON object per row")
    args = parser.parse_args()
    rows: Iterable[Row]
    if args.live is not None:
        rows = [train(args.live)]
    else:
        rows = map(measured, args.runs) if args.runs else recorded()
    if args.json:
        for row in rows:
            print(json.dumps(row._asdict()), flush=True)
        return
    table = Table(*(name.replace("_", " ") for name in Row._fields))
    for row in rows:
        table.add_row(*map(text, row))
    Console(width=140, highlight=False).print(table)


if __name__ == "__main__":
    main()
