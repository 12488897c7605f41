"""Figures of learning curves, for `plot` and `compare`."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hmasd_jax.analysis.colors import OKABE_ITO
from hmasd_jax.analysis.statistics import Array, mean_interval
from hmasd_jax.runs.folder import RunError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

COLORS = (*OKABE_ITO, "#444444")

EDITABLE_TEXT = {"pdf.fonttype": 42, "svg.fonttype": "none"}
"""Settings of matplotlib by which PDF and SVG keep their text as text."""
DASHES = ("-", (0, (6, 2)), (0, (2, 1.5)), (0, (6, 2, 1.5, 2)), (0, (9, 1.5)))
MARKERS = ("o", "s", "^", "D", "v")
MAX_CURVES = 5
"""Most curves of a panel; more cannot be told apart."""

Curve = tuple[Array, Array]
"""Environment steps (n,) and values (n,)."""
Group = tuple[str, Sequence[Curve]]
"""Label, and one curve per seed."""


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


def draw_curves(
    axes: "Axes",
    curves: Sequence[Curve],
    label: str,
    number: int = 0,
    show_seeds: bool = False,
) -> "Line2D":
    """Draw the mean over seeds and its interval.

    Args:
        axes: Axes to draw on.
        curves: One curve per seed.
        label: Name of the group.
        number: Place of the group in the figure. Each has its own color, dashes and places of
            markers, so that curves which coincide stay apart.
        show_seeds: If True, also draw a thin line per seed.

    Returns:
        The line of the mean, for `label_ends`.
    """
    color = COLORS[number % len(COLORS)]
    for own, values in curves if show_seeds else ():
        axes.plot(own, values, color=color, linewidth=0.7, alpha=0.35)
    steps, values = common_steps(curves)
    if len(curves) > 1 and len(steps):
        axes.fill_between(steps, *mean_interval(values), color=color, alpha=0.2, linewidth=0)
    mean = values.mean(axis=0)
    every = max(len(steps) // 4, MAX_CURVES)
    (line,) = axes.plot(
        steps,
        mean,
        color=color,
        linewidth=2.0,
        label=label,
        linestyle=DASHES[number % MAX_CURVES],
        marker=MARKERS[number % MAX_CURVES],
        markersize=4.5,
        markevery=(number % MAX_CURVES * every // MAX_CURVES, every),
    )
    return line


def label_ends(axes: "Axes", lines: Sequence["Line2D"]) -> None:
    """Write the label of each curve beside its end, so far apart that all can be read.

    Args:
        axes: Axes with finished limits.
        lines: Their curves.
    """
    points = [np.asarray(line.get_xydata(), float) for line in lines]
    ends = [(float(own[-1, 0]), float(own[-1, 1])) if len(own) else (0.0, 0.0) for own in points]
    low, high = axes.get_ylim()
    heights = np.array([(y - low) / (high - low) for _, y in ends])
    order = np.argsort(heights, kind="stable")
    places = _spread(heights[order], gap=0.075)
    for index, place in zip(order, places):
        line, end = lines[index], ends[index]
        axes.annotate(
            str(line.get_label()),
            xy=end,
            xytext=(1.03, float(place)),
            textcoords="axes fraction",
            color=line.get_color(),
            fontsize=9,
            verticalalignment="center",
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": line.get_color(),
                "alpha": 0.6,
                "linewidth": 0.7,
                "relpos": (0.0, 0.5),  # It meets the text at its left end.
            },
        )


def _spread(heights: Array, gap: float) -> Array:
    """Move sorted heights apart to at least `gap`, within 0 and 1 if there is room."""
    places = heights.copy()
    for index in range(1, len(places)):
        places[index] = max(places[index], places[index - 1] + gap)
    places[-1:] = np.minimum(places[-1:], 1.0)
    for index in range(len(places) - 2, -1, -1):
        places[index] = min(places[index], places[index + 1] - gap)
    return places


def draw_groups(
    groups: Sequence[Group],
    title: str,
    metric: str,
    out: Path,
    show_seeds: bool = False,
    styles: Sequence[int] | None = None,
) -> Path:
    """Draw groups of curves, at most `MAX_CURVES` a panel, each labeled at its end.

    Args:
        groups: Label and one curve per seed of each group.
        title: Title of the figure.
        metric: Name of the metric.
        out: Image to write: .png, .pdf, .svg, ..
        show_seeds: If True, also draw a thin line per seed.
        styles: Number of color and dashes of each group, which it can share with other figures. By
            default, each panel counts its own.

    Raises:
        RunError: `out` cannot be written.
    """
    from matplotlib.figure import Figure

    count = -(-len(groups) // MAX_CURVES)
    size = (6.4, 0.8 + 3.4 * count)
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    panels = figure.subplots(count, sharex=True, sharey=True, squeeze=False)[:, 0]
    for axes, part in zip(panels, np.array_split(np.arange(len(groups)), count)):
        numbers = range(len(part)) if styles is None else [styles[i] for i in part]
        lines = [
            draw_curves(axes, groups[i][1], groups[i][0], number, show_seeds)
            for i, number in zip(part, numbers)
        ]
        finish(axes, title if axes is panels[0] else "", metric)
        label_ends(axes, lines)
    name_band(panels[-1], [curves for _, curves in groups])
    for axes in panels[:-1]:
        axes.set_xlabel("")
    return save(figure, out)


def name_band(axes: "Axes", groups: Sequence[Sequence[Curve]]) -> None:
    """Say below the axes what the bands are, if there are any."""
    if any(len(curves) > 1 for curves in groups):
        note = "band: 95 % bootstrap interval of the mean over seeds"
        axes.set_xlabel(f"{axes.get_xlabel()}\n{note}", fontsize=9)


def write_csv(
    labels: Sequence[str], groups: Sequence[Mapping[int, Curve]], metric: str, out: Path
) -> Path:
    """Write curves as rows of label, seed, env_steps and value; return the file.

    Args:
        labels: Name of each group.
        groups: The curve of each seed, by the index of the seed.
        metric: Name of the column of values.
        out: Image that the curves are drawn in. The file beside it has the suffix .csv.
    """
    out = Path(out).with_suffix(".csv")
    with out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("label", "seed", "env_steps", metric))
        for label, curves in zip(labels, groups):
            for seed, curve in curves.items():
                writer.writerows((label, seed, int(x), float(y)) for x, y in zip(*curve))
    return out


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
    import matplotlib

    out = Path(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with matplotlib.rc_context(EDITABLE_TEXT):
            figure.savefig(out, format=out.suffix[1:])
    except (OSError, ValueError) as error:  # ValueError for an unknown format
        raise RunError(
            f"cannot write {out}: {getattr(error, 'strerror', None) or error}"
        ) from error
    return out
