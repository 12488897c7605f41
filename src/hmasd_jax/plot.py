"""Learning curves over seeds, from run folders and from recorded results.

Every curve is the mean over seeds with its 95 % bootstrap interval; thin lines are the seeds.
"""

import importlib
import json
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from hmasd_jax import logging, run_folder
from hmasd_jax.run_folder import RunError
from hmasd_jax.statistics import Array, mean_interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#444444")
"""Told apart by color-blind readers as well (Okabe and Ito)."""

ENTROPIES = {"coordinator/team_entropy": "team", "coordinator/skill_entropy": "individual"}
ACCURACIES = {
    "discriminators/team_accuracy": "team",
    "discriminators/individual_accuracy": "individual",
}
NUM_SKILLS = {"team": "num_team_skills", "individual": "num_skills"}
STYLES: dict[str, Literal["-", "--"]] = {"team": "-", "individual": "--"}

Curve = tuple[Array, Array]
"""Environment steps, and a value at each."""


class MissingPackageError(ImportError, RunError):
    """An optional package is not installed; the message is one line with the remedy."""


class Reference(NamedTuple):
    """Numbers of somebody else to draw beside a result."""

    label: str
    env_steps: Sequence[float]
    values: Sequence[float]
    """Mean over seeds at each of `env_steps`."""
    final: tuple[float, float] | None = None
    """Mean and standard deviation over seeds at the end."""


PAPER_ALICE_AND_BOB = Reference(
    "paper, Fig. 5 (5 seeds)",
    (0.5e6, 1.0e6, 1.3e6, 1.9e6, 2.5e6),
    (0.21, 0.60, 0.64, 0.55, 0.79),
    final=(0.74, 0.26),
)
"""HMASD's success on Alice_and_Bob, read off the figure; the final number is from the text."""


def plot_runs(runs: Sequence[Path], out: Path, metric: str = "success") -> Path:
    """Draw the evaluations of one or more runs, finished or not, and how skills separated.

    Args:
        runs: folders; each becomes one curve over its seeds.
        out: image to write; the suffix is its format.
        metric: name in the evaluations, e.g. `success`, `return` or `length`.

    Returns:
        `out`.

    Raises:
        MissingPackageError: matplotlib is not installed.
        RunError: a folder is not one of a run, or has no evaluation of that name yet, or `out`
            cannot be written.
    """
    require("matplotlib")
    runs = [Path(run) for run in runs]
    curves = [read_curves(run, "eval", metric) for run in runs]
    for run, seeds in zip(runs, curves):
        if not seeds:
            raise RunError(f"{run} has no evaluation of {metric} yet: {_known_metrics(run)}")
    tables = [json.loads((run / "config.json").read_text()) for run in runs]
    panels = _diagnostics(runs, tables)
    figure, main, side = _figure(panels=bool(panels))
    for seeds, label, color in zip(curves, _labels(runs, tables), _colors(len(runs))):
        draw_curves(main, seeds, label, color)
    names = sorted({table["env"]["name"] for table in tables})
    _finish(main, ", ".join(names), metric, legend=True)
    for axes, (title, lines) in zip(side, panels.items()):
        for curve, style, color in lines:
            axes.plot(*curve, color=color, linestyle=style, linewidth=1.4)
        _finish(axes, title, None)
    if panels:
        _explain_styles(side[0])
        side[-1].set_xlabel("environment steps", fontsize=8)
    return save(figure, out)


def plot_result(result: Path, out: Path, reference: Reference | None = None) -> Path:
    """Draw a recorded result.

    Args:
        result: JSON file with `metric`, `env_steps` (evaluations) and `values`
            (seeds, evaluations).
        out: image to write; the suffix is its format.
        reference: numbers to draw beside it, e.g. `PAPER_ALICE_AND_BOB`.

    Returns:
        `out`.

    Raises:
        MissingPackageError: matplotlib is not installed.
    """
    require("matplotlib")
    record = json.loads(Path(result).read_text())
    steps = np.asarray(record["env_steps"], float)
    values = np.asarray(record["values"], float)
    figure, axes, _ = _figure(panels=False)
    label = f"{Path(result).stem} ({len(values)} seeds)"
    draw_curves(axes, [(steps, row) for row in values], label, COLORS[0])
    if reference is not None:
        _draw_reference(axes, reference, steps[-1])
    _finish(axes, Path(result).parent.name, record["metric"], legend=True)
    return save(figure, out)


def read_curves(run: Path, kind: str, metric: str) -> list[Curve]:
    """One curve per seed that has any record of the metric; `kind` is `train` or `eval`."""
    run_folder.read_config(run)  # for its error where there is no run
    curves = []
    for seed in run_folder.seeds_of(run):
        records = logging.read(run_folder.metrics_path(run, seed))
        points = [
            (record["env_steps"], record[metric])
            for record in records
            if record["kind"] == kind and metric in record
        ]
        if points:
            steps, values = np.array(points, float).T
            curves.append((steps, values))
    return curves


def common_steps(curves: Sequence[Curve]) -> tuple[Array, Array]:
    """The environment steps (n,) that all seeds have reached, and values (seeds, n) there."""
    steps = curves[0][0]
    for others, _ in curves[1:]:
        steps = np.intersect1d(steps, others)
    return steps, np.array([values[np.isin(own, steps)] for own, values in curves])


def draw_curves(axes: "Axes", curves: Sequence[Curve], label: str, color: str) -> None:
    """Mean, interval of the mean, and all seeds."""
    for own, values in curves:
        axes.plot(own, values, color=color, linewidth=0.7, alpha=0.35)
    steps, values = common_steps(curves)
    if len(curves) > 1 and len(steps):
        axes.fill_between(steps, *mean_interval(values), color=color, alpha=0.2, linewidth=0)
    axes.plot(steps, values.mean(axis=0), color=color, linewidth=2.2, label=label)


def require(package: str) -> ModuleType:
    """Import an optional package.

    Raises:
        MissingPackageError: it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise MissingPackageError(
            f"the package {package} is not installed: pip install 'hmasd-jax[plots]'"
        ) from error


def _diagnostics(runs: list[Path], tables: list[dict]) -> dict[str, list[tuple[Curve, str, str]]]:
    """Title and (curve, line style, color) of each side panel: means over seeds.

    Entropies are divided by those of uniform choice, so that all lie in [0, 1]. A level with a
    single skill has nothing to show.
    """
    panels = {"skill entropy / uniform": ENTROPIES, "discriminator accuracy": ACCURACIES}
    found: dict[str, list[tuple[Curve, str, str]]] = {title: [] for title in panels}
    for run, table, color in zip(runs, tables, _colors(len(runs))):
        for title, metrics in panels.items():
            for metric, level in metrics.items():
                count = table["algorithm"].get(NUM_SKILLS[level], 1)
                curves = read_curves(run, "train", metric)
                if count < 2 or not curves:
                    continue
                steps, values = common_steps(curves)
                scale = np.log(count) if metrics is ENTROPIES else 1.0
                found[title].append(((steps, values.mean(axis=0) / scale), STYLES[level], color))
    return {title: lines for title, lines in found.items() if lines}


def _draw_reference(axes: "Axes", reference: Reference, end: float) -> None:
    """Points of the reference's curve, and its final mean with standard deviation at `end`."""
    color = "#333333"
    axes.plot(
        reference.env_steps, reference.values, "s:", color=color, markersize=5, linewidth=1,
        label=reference.label,
    )  # fmt: skip
    if reference.final is not None:
        mean, std = reference.final
        axes.errorbar(
            end, mean, yerr=std, fmt="D", color=color, capsize=4, markersize=5, linewidth=1,
            label=f"  its final {mean:.0%} ± {std:.0%} (std)",
        )  # fmt: skip


def _figure(panels: bool) -> tuple["Figure", "Axes", list["Axes"]]:
    """A wide panel, and two small ones stacked beside it if asked for."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0 if panels else 6.4, 4.2), dpi=150, layout="constrained")
    if not panels:
        return figure, figure.add_subplot(), []
    grid = figure.add_gridspec(2, 2, width_ratios=(1.9, 1.0))
    side = [figure.add_subplot(grid[row, 1]) for row in range(2)]
    return figure, figure.add_subplot(grid[:, 0]), side


def _finish(axes: "Axes", title: str, metric: str | None, legend: bool = False) -> None:
    """Titles, units and quiet decoration; fractions are shown in percent."""
    from matplotlib.ticker import EngFormatter, PercentFormatter

    axes.set_title(title, fontsize=11 if metric else 9, loc="left")
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlim(left=0)
    if metric is None or metric == "success":
        axes.set_ylim(-0.03, 1.03)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    if metric is None:
        axes.tick_params(labelsize=8)
        return
    axes.set_xlabel("environment steps")
    axes.set_ylabel("success rate" if metric == "success" else metric)
    if legend:
        axes.legend(frameon=False, fontsize=9)


def _explain_styles(axes: "Axes") -> None:
    """What solid and dashed lines are."""
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], color="#444444", linestyle=s, label=k) for k, s in STYLES.items()]
    axes.legend(handles=lines, frameon=False, fontsize=8, loc="best")


def _labels(runs: list[Path], tables: list[dict[str, Any]]) -> list[str]:
    """Names of the algorithms if they tell the runs apart, else names of the folders."""
    names = [table["algorithm"]["name"] for table in tables]
    if len(set(names)) < len(names):
        names = [run.resolve().name for run in runs]
    counts = [len(run_folder.seeds_of(run)) for run in runs]
    return [f"{name} ({n} seed{'s' * (n > 1)})" for name, n in zip(names, counts)]


def _colors(count: int) -> list[str]:
    return [COLORS[i % len(COLORS)] for i in range(count)]


def _known_metrics(run: Path) -> str:
    """What could be plotted instead."""
    for seed in run_folder.seeds_of(run):
        for record in logging.read(run_folder.metrics_path(run, seed)):
            if record["kind"] == "eval":
                return f"there are {', '.join(sorted(set(record) - logging.NOT_METRICS))}"
    return "wait for its first one"


def save(figure: "Figure", out: Path) -> Path:
    """Write a figure in the format of the suffix.

    Raises:
        RunError: it cannot be written.
    """
    out = Path(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(out)
    except (OSError, ValueError) as error:  # the latter for a format it does not know
        raise RunError(
            f"cannot write {out}: {getattr(error, 'strerror', None) or error}"
        ) from error
    return out
