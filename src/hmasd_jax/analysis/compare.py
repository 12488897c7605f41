"""Comparison of runs on one task: curves, and statistics over seeds with 95 % intervals.

The statistics are interquartile means, bootstrap intervals over seeds, and the probability that a
seed of one algorithm does better than a seed of another.

References:
    Agarwal et al., `Deep Reinforcement Learning at the Edge of the Statistical Precipice
    <https://arxiv.org/abs/2108.13264>`_, 2021
"""

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

from rich.table import Table

from envs_jax.optional import require
from hmasd_jax.analysis.curves import labels_of, read_evaluations
from hmasd_jax.analysis.figures import Curve, common_steps, draw_groups, write_csv
from hmasd_jax.analysis.learning import ANY_REWARD, LAST, common_metric, default_bar
from hmasd_jax.analysis.statistics import (
    Array,
    Estimate,
    estimate,
    estimate_fraction,
    estimate_iqm,
    estimate_mean,
    few_seeds,
    last_evaluations,
    probability_of_improvement,
)
from hmasd_jax.config import TrainConfig, to_json
from hmasd_jax.runs.folder import RunError, read_config

ENCODINGS = ("observation", "state")
"""Settings of environments that say how a task is seen, and not what it is."""


class Comparison(NamedTuple):
    """Results of several runs on one task."""

    task: str
    """Name of the environment."""
    metric: str
    """Name of the metric in the evaluations."""
    labels: list[str]
    """One label per run."""
    curves: list[dict[int, Curve]]
    """For each run, the curve of each seed, by the index of the seed."""
    env_steps: int
    """Last step at which all seeds of all runs were evaluated. The scores are taken there."""
    scores: list[Array]
    """For each run, one score per seed: the mean of its last evaluations up to `env_steps`."""
    last: int
    """Number of evaluations in a score."""
    solved_at: float
    """Lowest score of a seed that has solved the task."""

    def draw(self, out: Path, show_seeds: bool = False) -> Path:
        """Draw the curves with their intervals, write them as CSV beside it, and return `out`."""
        require("matplotlib", "plots", "plotting")
        groups = [(label, list(own.values())) for label, own in zip(self.labels, self.curves)]
        draw_groups(groups, self.task, self.metric, out, show_seeds)
        write_csv(self.labels, self.curves, self.metric, out)
        return Path(out)


def compare_runs(
    runs: Sequence[Path],
    metric: str | None = None,
    last: int = LAST,
    solved_at: float | None = None,
) -> Comparison:
    """Read the evaluations of runs on one task.

    Args:
        runs: Folders of runs, finished or not.
        metric: Name in the evaluations, e.g. `success` or `return`; None takes success if all
            runs have it, else the return.
        last: Number of evaluations to average for a seed's score.
        solved_at: Lowest score of a seed that has solved the task; None takes a success rate of
            0.9, or any return above 0.

    Raises:
        RunError: A folder is not the folder of a run, the tasks differ, or there are too few
            evaluations.
    """
    runs = [Path(run) for run in runs]
    metric = common_metric(runs) if metric is None else metric
    curves = [read_evaluations(run, metric) for run in runs]
    configs = [read_config(run) for run in runs]
    for run, config in zip(runs, configs):
        if differences := _name_differences(configs[0], config):
            raise RunError(
                f"{run} is on another task than {runs[0]}: {differences}; `plot` draws runs of any"
            )
    groups = [list(seeds.values()) for seeds in curves]
    steps, _ = common_steps([curve for seeds in groups for curve in seeds])
    steps = steps[steps > 0]  # The evaluation at step 0 is of the untrained policy.
    if len(steps) < last:
        remedy = "wait for more, or ask for fewer with --last"
        firsts = {int(own[own > 0][0]) for own, _ in map(common_steps, groups) if own.any()}
        if not len(steps) and len(firsts) > 1:
            remedy = (
                f"they begin at {sorted(firsts)}; train with equal eval_interval, or see `plot`"
            )
        raise RunError(
            f"the seeds of these runs have {len(steps)} evaluations of {metric} after step 0 in "
            f"common, and a score needs {last}: {remedy}"
        )
    scores = []
    for seeds in groups:
        own, values = common_steps(seeds)
        scores.append(last_evaluations(values[:, (own > 0) & (own <= steps[-1])], last))
    return Comparison(
        task=to_json(configs[0])["env"]["name"],
        metric=metric,
        labels=labels_of(runs, [to_json(config) for config in configs], curves),
        curves=curves,
        env_steps=int(steps[-1]),
        scores=scores,
        last=last,
        solved_at=default_bar(metric) if solved_at is None else solved_at,
    )


def are_one_task(configs: Sequence[TrainConfig]) -> bool:
    """Return whether runs with these configurations can be compared."""
    return not any(_name_differences(configs[0], config) for config in configs)


def _name_differences(one: TrainConfig, other: TrainConfig) -> str:
    """Return a text on the settings that make `other` another task; empty if none does."""
    old, new = (to_json(config)["env"] for config in (one, other))
    if old["name"] != new["name"]:  # All settings differ, too.
        return f"{new['name']}, not {old['name']}"
    names = [name for name in new if name not in ENCODINGS and new[name] != old[name]]
    return ", ".join(f"{name} is {new[name]}, not {old[name]}" for name in names)


def tables(comparison: Comparison) -> list[Table]:
    """Return the statistics as tables: one of the runs, and one of the pairs of runs."""
    labels, scores, bar = comparison.labels, comparison.scores, comparison.solved_at
    solved_seeds = "seeds > 0" if bar == ANY_REWARD else f"seeds ≥ {bar:g}"
    per_run = Table(
        "run", "seeds", "interquartile mean", "mean", solved_seeds,
        title=f"{comparison.task}: {comparison.metric} of the last {comparison.last} evaluations "
        f"up to {comparison.env_steps:,} env steps; 95 % intervals",
    )  # fmt: skip
    per_run.caption = few_seeds(min(map(len, scores)))
    for label, own in zip(labels, scores):
        statistics = estimate_iqm(own), estimate_mean(own), estimate_fraction(own, bar)
        per_run.add_row(label, str(len(own)), *map(_write, statistics))
    if len(scores) < 2:
        return [per_run]
    per_pair = Table("", "", "probability", title="Probability that a seed of the first is better")
    for first, second in combinations(range(len(scores)), 2):
        better = estimate(
            [scores[first], scores[second]], lambda groups: probability_of_improvement(*groups)
        )
        per_pair.add_row(labels[first], labels[second], _write(better))
    return [per_run, per_pair]


def _write(estimate: Estimate) -> str:
    return f"{estimate.value:.3f} [{estimate.low:.3f}, {estimate.high:.3f}]"
