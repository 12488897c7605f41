"""Scores of a trial, from the metrics that its run has on disk.

The score of a seed is the mean of its last evaluations, without the one before training. The score
of a trial is the mean over its seeds.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from hmasd_jax.analysis.learning import main_metric
from hmasd_jax.analysis.statistics import seed_score
from hmasd_jax.runs import metrics_log
from hmasd_jax.runs.folder import metrics_path


def read_evaluations(run: Path, num_seeds: int) -> tuple[str, list[list[float]]]:
    """Read what a run was judged by so far.

    Args:
        run: Folder of the run.
        num_seeds: Number of its seeds.

    Returns:
        The metric, success or else return, and its evaluations after step 0 for each seed.
    """
    seeds = [metrics_log.read(metrics_path(run, seed)) for seed in range(num_seeds)]
    rows = [metrics_log.evaluations(seed) for seed in seeds]
    metric = main_metric(next((row for seed in rows for row in seed), {"success": 0}))
    return metric, [[row[metric] for row in seed if metric in row] for seed in rows]


def scores_so_far(
    evaluations: Sequence[Sequence[float]], at_once: int, total: int, last: int
) -> Iterator[tuple[int, float]]:
    """Yield the score of a trial after each of its evaluations.

    Where not all seeds train at once, they do so in groups. A group counts from the evaluation that
    all of its seeds have, with the finished seeds of the groups before it.

    Args:
        evaluations: Evaluations of each seed.
        at_once: Number of seeds that train at once.
        total: Number of evaluations of a finished seed.
        last: Number of last evaluations that count.

    Yields:
        Number of evaluations, those of the groups before included, and score. After `total`
        evaluations of the last group, it is the score of the trial.
    """
    for index, first in enumerate(range(0, len(evaluations), at_once)):
        done = [seed_score(seed, last) for seed in evaluations[:first]]
        group = evaluations[first : first + at_once]
        reached = min(map(len, group))
        for number in range(1, reached + 1):
            own = [seed_score(seed[:number], last) for seed in group]
            yield index * total + number, float(np.mean(done + own))
        if reached < total:
            return
