"""Figures of learning curves, for `plot` and `compare`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hmasd_jax.analysis.statistics import Array, mean_interval
from hmasd_jax.runs.folder import RunError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#444444")
"""Colors that color-blind readers can tell apart (Okabe and Ito)."""

Curve = tuple[Array, Array]
"""Environment steps (n,) and values (n,)."""


def common_steps(curves: Sequence[Curve]) -> tuple[Array, Array]:
    """Return the steps (n,) that all seeds have in common, and their values (seeds, n)."""
    steps = curves[0][0]
    for others, _ in curves[1:]:
        steps = np.intersect1d(steps, others)
    return steps, np.array([values[np.isin(own, steps)] for own, values in curves])


def colors(count: int) -> list[str]:
    """Return one color per curve, repeating them if there are not enough."""
    return [COLORS[i % len(COLORS)] for i in range(count)]


def new_figure(panels: bool) -> tuple["Figure", "Axes", list["Axes"]]:
    """Create a figure with a wide panel and, if `panels`, two small ones beside it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0 if panels else 6.4, 4.2), dpi=150, layout="constrained")
    if not panels:
        return figure, figure.add_subplot(), []
    grid = figure.add_gridspec(2, 2, width_ratios=(1.9, 1.0))
    side = [figure.add_subplot(grid[row, 1]) for row in range(2)]
    return figure, figure.add_subplot(grid[:, 0]), side


def draw_curves(axes: "Axes", curves: Sequence[Curve], label: str, color: str) -> None:
    """Draw the mean over seeds, its interval, and a thin line per seed."""
    for own, values in curves:
        axes.plot(own, values, color=color, linewidth=0.7, alpha=0.35)
    steps, values = common_steps(curves)
    if len(curves) > 1 and len(steps):
        axes.fill_between(steps, *mean_interval(values), color=color, alpha=0.2, linewidth=0)
    axes.plot(steps, values.mean(axis=0), color=color, linewidth=2.2, label=label)


def draw_groups(
    groups: Sequence[tuple[str, Sequence[Curve]]], title: str, metric: str, out: Path
) -> Path:
    """Draw groups of curves into one panel, each with its own label and color.

    Raises:
        RunError: `out` cannot be written.
    """
    figure, axes, _ = new_figure(panels=False)
    for (label, curves), color in zip(groups, colors(len(groups))):
        draw_curves(axes, curves, label, color)
    finish(axes, title, metric, legend=True)
    return save(figure, out)


def finish(axes: "Axes", title: str, metric: str | None, legend: bool = False) -> None:
    """Set title, axis labels and ticks. Fractions are shown in percent."""
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


def save(figure: "Figure", out: Path) -> Path:
    """Write a figure in the format of the suffix and return `out`.

    Raises:
        RunError: The file cannot be written.
    """
    out = Path(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(out)
    except (OSError, ValueError) as error:  # ValueError for an unknown format
        raise RunError(
            f"cannot write {out}: {getattr(error, 'strerror', None) or error}"
        ) from error
    return out
