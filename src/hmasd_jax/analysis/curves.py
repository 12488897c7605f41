"""Learning curves over seeds, from run folders and from recorded results.

Each curve is the mean over seeds with its 95 % bootstrap interval.
"""

import json
from collections.abc import Sequence, Sized
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from envs_jax.optional import require
from hmasd_jax.analysis.figures import (
    MAX_CURVES,
    Curve,
    colors,
    common_steps,
    draw_curves,
    draw_groups,
    finish,
    label_ends,
    name_band,
    new_figure,
    save,
    write_csv,
)
from hmasd_jax.analysis.learning import common_metric, read_records
from hmasd_jax.config import to_json
from hmasd_jax.runs import metrics_log
from hmasd_jax.runs.folder import RunError, read_config

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ENTROPIES = {"coordinator/team_entropy": "team", "coordinator/skill_entropy": "individual"}
ACCURACIES = {
    "discriminators/team_accuracy": "team",
    "discriminators/individual_accuracy": "individual",
}
NUM_SKILLS = {"team": "num_team_skills", "individual": "num_skills"}
STYLES: dict[str, Literal["-", "--"]] = {"team": "-", "individual": "--"}


class Reference(NamedTuple):
    """Published numbers to draw beside a result."""

    label: str
    """Name in the legend."""
    env_steps: Sequence[float]
    """Environment steps of the values."""
    values: Sequence[float]
    """Mean over seeds at each of `env_steps`."""
    final: tuple[float, float] | None = None
    """Mean and standard deviation over seeds at the end."""


def plot_runs(
    runs: Sequence[Path], out: Path, metric: str | None = None, show_seeds: bool = False
) -> Path:
    """Draw the evaluations of one or more runs, finished or not, and write them as CSV beside it.

    Up to five runs with skills also get panels of skill entropies and discriminator accuracies.

    Args:
        runs: Folders of runs. Each becomes one curve over its seeds.
        out: Image to write. Its suffix selects the format: .png, .pdf, .svg, ..
        metric: Name in the evaluations, e.g. `success`, `return` or `length`; None takes success
            if all runs have it, else the return.
        show_seeds: If True, also draw a thin line per seed.

    Returns:
        `out`.

    Raises:
        MissingPackageError: matplotlib is not installed.
        RunError: A folder is not the folder of a run or has no such evaluation yet, or `out` cannot
            be written.
    """
    require("matplotlib", "plots", "plotting")
    runs = [Path(run) for run in runs]
    metric = common_metric(runs) if metric is None else metric
    curves = [read_evaluations(run, metric) for run in runs]
    tables = [to_json(read_config(run)) for run in runs]
    labels = labels_of(runs, tables, curves)
    groups = [(label, list(seeds.values())) for label, seeds in zip(labels, curves)]
    title = ", ".join(sorted({table["env"]["name"] for table in tables}))
    panels = _diagnostics(runs, tables)
    if not panels or len(runs) > MAX_CURVES:
        draw_groups(groups, title, metric, out, show_seeds)
        write_csv(labels, curves, metric, out)
        return Path(out)
    figure, main, side = new_figure(panels=True)
    means = [
        draw_curves(main, seeds, label, number, show_seeds)
        for number, (label, seeds) in enumerate(groups)
    ]
    finish(main, title, metric)
    label_ends(main, means)
    name_band(main, [seeds for _, seeds in groups])
    for axes, (title, lines) in zip(side, panels.items()):
        for curve, style, color in lines:
            axes.plot(*curve, color=color, linestyle=style, linewidth=1.4)
        finish(axes, title, None)
    _explain_styles(side[0])
    side[-1].set_xlabel("environment steps", fontsize=8)
    save(figure, out)
    write_csv(labels, curves, metric, out)
    return Path(out)


def plot_result(result: Path, out: Path, reference: Reference | None = None) -> Path:
    """Draw a recorded result.

    Args:
        result: JSON file with `metric`, `env_steps` (evaluations) and `values`
            (seeds, evaluations). A seed may have fewer evaluations than others.
        out: Image to write. Its suffix selects the format.
        reference: Numbers to draw beside it, in the units of the metric.

    Returns:
        `out`.

    Raises:
        MissingPackageError: matplotlib is not installed.
    """
    require("matplotlib", "plots", "plotting")
    record = json.loads(Path(result).read_text())
    label, curves = recorded_curves(result)
    figure, axes, _ = new_figure(panels=False)
    draw_curves(axes, curves, label, show_seeds=True)
    if reference is not None:
        end = record["env_steps"][-1]
        _draw_reference(axes, reference, end, percent=record["metric"] == "success")
    finish(axes, Path(result).parent.name, record["metric"], legend=True)
    return save(figure, out)


def recorded_curves(result: Path) -> tuple[str, list[Curve]]:
    """Return the label and the curves of a recorded result, one curve per seed.

    A seed that was stopped keeps its last value.
    """
    record = json.loads(Path(result).read_text())
    steps = np.asarray(record["env_steps"], float)
    curves = [
        (steps, np.pad(np.asarray(values, float), (0, len(steps) - len(values)), "edge"))
        for values in record["values"]
    ]
    seeds = "1 seed" if len(curves) == 1 else f"{len(curves)} seeds"
    return f"{Path(result).stem} ({seeds})", curves


def read_evaluations(run: Path, metric: str) -> dict[int, Curve]:
    """Read the evaluations of a run, one curve per seed, by the index of the seed.

    Raises:
        RunError: `run` is not the folder of a run, or has no evaluation of that name yet.
    """
    curves = read_curves(run, "eval", metric)
    if not curves:
        raise RunError(f"{run} has no evaluation of {metric} yet: {_known_metrics(run)}")
    return curves


def read_curves(run: Path, kind: str, metric: str) -> dict[int, Curve]:
    """Read a curve for each seed that has a record of the metric, by the index of the seed.

    Args:
        run: Folder of the run.
        kind: Kind of the records, `train` or `eval`.
        metric: Name in the records.

    Raises:
        RunError: `run` is not the folder of a run.
    """
    curves = {}
    for seed, records in read_records(run).items():
        points = [
            (record["env_steps"], record[metric])
            for record in records
            if record["kind"] == kind and metric in record.keys() - metrics_log.NOT_METRICS
        ]
        if points:
            steps, values = np.array(points, float).T
            curves[seed] = (steps, values)
    return curves


def _diagnostics(runs: list[Path], tables: list[dict]) -> dict[str, list[tuple[Curve, str, str]]]:
    """Return the title and the lines (curve, style, color) of each side panel.

    Curves are means over seeds. Entropies are divided by the entropy of a uniform choice, so that
    they lie in [0, 1]. Levels with a single skill are left out.
    """
    panels = {"skill entropy / uniform": ENTROPIES, "discriminator accuracy": ACCURACIES}
    found: dict[str, list[tuple[Curve, str, str]]] = {title: [] for title in panels}
    for run, table, color in zip(runs, tables, colors(len(runs))):
        for title, metrics in panels.items():
            for metric, level in metrics.items():
                count = table["algorithm"].get(NUM_SKILLS[level], 1)
                curves = read_curves(run, "train", metric)
                if count < 2 or not curves:
                    continue
                steps, values = common_steps(list(curves.values()))
                scale = np.log(count) if metrics is ENTROPIES else 1.0
                found[title].append(((steps, values.mean(axis=0) / scale), STYLES[level], color))
    return {title: lines for title, lines in found.items() if lines}


def _draw_reference(axes: "Axes", reference: Reference, end: float, percent: bool) -> None:
    """Draw the curve of a reference, and its final mean and standard deviation at `end`."""
    color = "#333333"
    axes.plot(
        reference.env_steps, reference.values, "s:", color=color, markersize=5, linewidth=1,
        label=reference.label,
    )  # fmt: skip
    if reference.final is not None:
        mean, std = reference.final
        written = f"{mean:.0%} ± {std:.0%}" if percent else f"{mean:.0f} ± {std:.0f}"
        axes.errorbar(
            end, mean, yerr=std, fmt="D", color=color, capsize=4, markersize=5, linewidth=1,
            label=f"  its final {written} (std)",
        )  # fmt: skip


def _explain_styles(axes: "Axes") -> None:
    """Add a legend for solid and dashed lines."""
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], color="#444444", linestyle=s, label=k) for k, s in STYLES.items()]
    axes.legend(handles=lines, frameon=False, fontsize=8, loc="best")


def labels_of(runs: list[Path], tables: list[dict[str, Any]], seeds: Sequence[Sized]) -> list[str]:
    """Return one label per run: the algorithm if all differ, else the name of the folder.

    Folders that share their name have the names of parents before it, until they differ.

    Args:
        runs: Folders of the runs.
        tables: Their configurations.
        seeds: For each run, the seeds that are shown, which the label counts.
    """
    names = [table["algorithm"]["name"] for table in tables]
    if len(set(names)) < len(names):
        folders, depth = [run.resolve().parts for run in runs], 1
        while len({parts[-depth:] for parts in folders}) < len(set(folders)):
            depth += 1
        names = ["/".join(parts[-depth:]) for parts in folders]
    counts = map(len, seeds)
    return [f"{name} ({n} seed{'s' * (n != 1)})" for name, n in zip(names, counts)]


def _known_metrics(run: Path) -> str:
    """Return a text that names the metrics of the run's evaluations."""
    for records in read_records(run).values():
        for record in records:
            if record["kind"] == "eval":
                known = sorted(set(record) - metrics_log.NOT_METRICS - {"wall_seconds"})
                return f"there are {', '.join(known)}; choose one by --metric"
    return "wait for its first one"
