"""Learning of one run over its seeds: bands of every logged metric, and what a table says of it.

Scores leave out the evaluation at step 0, which is of the untrained policy.
"""

from collections.abc import Container, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmasd_jax.analysis.figures import common_steps
from hmasd_jax.analysis.statistics import (
    Array,
    Estimate,
    estimate_fraction,
    estimate_iqm,
    estimate_mean,
    mean_interval,
    seed_score,
)
from hmasd_jax.runs import metrics_log
from hmasd_jax.runs.folder import metrics_path, read_config, seeds_of
from hmasd_jax.runs.metrics_log import NOT_METRICS, Record

LAST = 5
"""Number of last evaluations whose mean is the score of a seed, to even out their noise."""
SOLVED_AT = 0.9
"""Success rate from which a seed has solved a task."""
ANY_REWARD = 1e-9
"""Return from which a seed has solved a task without a success: any above 0."""


class Band(NamedTuple):
    """One metric over S seeds at the n steps that all of them have logged."""

    env_steps: Array
    """(n,)."""
    seconds: Array
    """Wall clock time of training without compilation, mean over seeds, (n,)."""
    values: Array
    """(S, n)."""
    low: Array
    """Lower end of the 95 % bootstrap interval of the mean, (n,)."""
    high: Array
    """Upper end, (n,)."""

    @property
    def mean(self) -> Array:
        """Mean over seeds, (n,)."""
        return self.values.mean(axis=0)


class Learned(NamedTuple):
    """Statistics over the seeds of one run."""

    metric: str
    seeds: int
    last: int
    """Number of evaluations in a seed's score. A seed that has fewer counts with all of them."""
    mean: Estimate
    iqm: Estimate
    """Interquartile mean."""
    threshold: float
    """Score from which a seed has solved the task."""
    solved: Estimate
    """Share of seeds that have solved the task."""
    reached: list[tuple[int, float]]
    """Environment steps and seconds of the first evaluation at or above the threshold, for each
    seed that has one."""


def read_records(run: Path | str) -> dict[int, list[Record]]:
    """Read all records of a run by seed.

    Raises:
        RunError: `run` is not the folder of a run, or a file cannot be read.
        ConfigError: The configuration of the run is not valid in this version.
    """
    run = Path(run)
    read_config(run)  # raises the errors
    return {seed: metrics_log.read(metrics_path(run, seed)) for seed in seeds_of(run)}


def bands(records: dict[int, list[Record]], kind: str) -> dict[str, Band]:
    """Return a band per metric of the records of one kind, `train` or `eval`.

    Seeds without a record of the metric are left out.
    """
    own = {seed: [r for r in rows if r["kind"] == kind] for seed, rows in records.items()}
    names = {name: None for rows in own.values() for row in rows for name in row}
    found = {}
    for name in names:
        if name in NOT_METRICS or name == "wall_seconds":
            continue
        curves = [[row for row in rows if name in row] for rows in own.values()]
        curves = [rows for rows in curves if rows]
        steps, values = common_steps([_curve(rows, name) for rows in curves])
        if not len(steps):
            continue
        _, seconds = common_steps([_curve(rows, "wall_seconds") for rows in curves])
        low, high = mean_interval(values)
        found[name] = Band(
            env_steps=steps, seconds=seconds.mean(axis=0), values=values, low=low, high=high
        )
    return found


def _curve(rows: Sequence[Record], name: str) -> tuple[NDArray, NDArray]:
    steps, values = np.array([(row["env_steps"], row[name]) for row in rows], float).T
    return steps, values


def summarize(
    records: dict[int, list[Record]], metric: str, solved_at: float, last: int = LAST
) -> Learned | None:
    """Return the statistics of the evaluations; None before the first one after step 0.

    Args:
        records: Records by seed.
        metric: Name in the evaluations.
        solved_at: Score from which a seed has solved the task.
        last: Number of last evaluations to average.
    """
    evaluations = [
        [row for row in metrics_log.evaluations(rows) if metric in row] for rows in records.values()
    ]
    evaluations = [rows for rows in evaluations if rows]
    if not evaluations:
        return None
    scores = np.array([seed_score([row[metric] for row in rows], last) for rows in evaluations])
    firsts = (next((r for r in rows if r[metric] >= solved_at), None) for rows in evaluations)
    return Learned(
        metric=metric,
        seeds=len(scores),
        last=min(last, max(map(len, evaluations))),
        mean=estimate_mean(scores),
        iqm=estimate_iqm(scores),
        threshold=solved_at,
        solved=estimate_fraction(scores, solved_at),
        reached=[(row["env_steps"], row["wall_seconds"]) for row in firsts if row],
    )


def main_metric(names: Container[str]) -> str:
    """Return the metric that a task is judged by: success if it has one, else the return.

    Args:
        names: Names of the metrics of its evaluations, e.g. one record.
    """
    return "success" if "success" in names else "return"


def common_metric(runs: Sequence[Path]) -> str:
    """Return the metric that all runs can be judged by: success if all have it, else the return.

    Runs without an evaluation do not count.

    Raises:
        RunError: A folder is not the folder of a run, or a file cannot be read.
        ConfigError: The configuration of a run is not valid in this version.
    """
    for run in runs:
        rows = [row for seed in read_records(run).values() for row in seed if row["kind"] == "eval"]
        if rows and main_metric(rows[-1]) != "success":
            return "return"
    return "success"


def default_bar(metric: str) -> float:
    """Return the score from which a seed has solved a task that is judged by this metric."""
    return SOLVED_AT if metric == "success" else ANY_REWARD


def curve_rows(records: dict[int, list[Record]]) -> list[dict[str, Any]]:
    """Return tidy rows: seed, kind, env_steps, wall_seconds, metric and value."""
    where = ("seed", "kind", "env_steps", "wall_seconds")
    return [
        {name: row[name] for name in where} | {"metric": name, "value": value}
        for rows in records.values()
        for row in rows
        for name, value in row.items()
        if name not in where
    ]
