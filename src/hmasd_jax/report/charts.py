"""Interactive charts, as HTML that needs Plotly's script once per page.

Text takes the color of the page, so that charts suit its light and its dark theme.
"""

from collections.abc import Sequence
from itertools import count
from typing import Any

import numpy as np
import plotly.graph_objects as go

from hmasd_jax.analysis.colors import OKABE_ITO
from hmasd_jax.analysis.frames import SKILL_COLORS, TEAM_COLORS
from hmasd_jax.analysis.learning import Band
from hmasd_jax.analysis.skill_space import SkillSpace
from hmasd_jax.analysis.skills import FREE, Level, SkillStudy
from hmasd_jax.analysis.statistics import Estimate, estimate_mean
from hmasd_jax.analysis.usefulness import Usefulness

RUN_COLORS = (*OKABE_ITO, "#8A8A8A")
"""The gray shows on both themes."""
GRID = "rgba(128,128,128,0.25)"
FONT = "system-ui, sans-serif"
CONFIG = {
    "displaylogo": False,
    "responsive": True,
    "modeBarButtonsToRemove": ["lasso2d", "select2d"],
}
MAX_POINTS = 400
"""Most points of a curve; longer ones are thinned out."""


def embed(figure: go.Figure, name: str, tools: bool = True) -> str:
    """Return a figure as an HTML element with the id `name`, without Plotly's script.

    Args:
        figure: The figure.
        name: Id of the element, unique on the page.
        tools: If True, buttons to zoom and to save a picture show while the mouse is over it.
    """
    config = CONFIG if tools else CONFIG | {"displayModeBar": False}
    return figure.to_html(
        full_html=False, include_plotlyjs=False, config=config, div_id=name, auto_play=False
    )


def new_figure(height: int, **layout: Any) -> go.Figure:
    """Return an empty figure in the style of the page."""
    return dress(go.Figure(), height, **layout)


def dress(figure: go.Figure, height: int, **layout: Any) -> go.Figure:
    """Give a figure the style of the page, and return it."""
    axis = {"gridcolor": GRID, "zerolinecolor": GRID, "linecolor": GRID, "automargin": True}
    figure.update_layout(
        height=height,
        margin={"l": 10, "r": 10, "t": 36, "b": 10},
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
        font={"family": FONT, "size": 13},
        hoverlabel={"font": {"family": FONT}},
        modebar={"bgcolor": "rgba(0,0,0,0)", "color": "#8A8A8A", "activecolor": "#0072B2"},
        legend={"orientation": "h", "y": -0.2, "x": 0},
        xaxis=axis,
        yaxis=axis,
    )
    return figure.update_layout(**layout)


def color_of(level: Level, skill: int) -> str:
    """Return the color of a skill, the same as in films."""
    colors = TEAM_COLORS if level == "team" else SKILL_COLORS
    return colors[skill % len(colors)]


def letter(level: Level, skill: int) -> str:
    """Return the name of a skill in the paper's letters."""
    return f"Z = {skill}" if level == "team" else f"z = {skill}"


def percent_axis(metric: str) -> dict[str, Any]:
    """Return the settings of an axis that shows `metric`."""
    share = metric == "success" or metric.endswith("accuracy")
    return {"tickformat": ".0%", "range": [-0.03, 1.03]} if share else {"tickformat": ".3~g"}


def draw_bands(
    curves: Sequence[tuple[str, Band | None]], metric: str, title: str, height: int = 380
) -> go.Figure:
    """Draw the mean over seeds of one metric for each run, with its 95 % bootstrap interval.

    A button exchanges environment steps for wall clock time. Thin lines of the seeds are off until
    they are chosen in the legend.
    """
    figure = new_figure(height, title={"text": title, "font": {"size": 14}, "x": 0.01})
    times: list[np.ndarray] = []
    steps: list[np.ndarray] = []

    def add(band_x: tuple[np.ndarray, np.ndarray], y: np.ndarray, **style: Any) -> None:
        steps.append(band_x[0])
        times.append(band_x[1])
        figure.add_trace(go.Scatter(x=band_x[0], y=y, **style))

    for (label, band), color in zip(curves, _cycle(RUN_COLORS)):
        if band is not None:
            _add_band(add, label, _thin(band), color)
    figure.update_xaxes(title="environment steps", rangemode="tozero", tickformat="~s")
    figure.update_yaxes(**percent_axis(metric))
    axes = (("env steps", steps, "environment steps", "~s"),
            ("wall clock", times, "seconds of training", ",d"))  # fmt: skip
    buttons = [
        {
            "label": label,
            "method": "update",
            "args": [{"x": x}, {"xaxis.title.text": text, "xaxis.tickformat": form}],
        }
        for label, x, text, form in axes
    ]
    menu = {"type": "buttons", "direction": "right", "buttons": buttons, "x": 1, "xanchor": "right",
            "y": 1.02, "yanchor": "bottom", "pad": {"t": 0, "b": 0}, "font": {"size": 11},
            "bgcolor": "rgba(128,128,128,0.15)", "bordercolor": GRID}  # fmt: skip
    return figure.update_layout(updatemenus=[menu])


def _add_band(add: Any, label: str, band: Band, color: str) -> None:
    """Add the interval, the mean, and the hidden lines of the seeds of one run."""
    x = band.env_steps, band.seconds
    group = {"legendgroup": label, "line": {"color": color, "width": 2.5}}
    add(x, band.mean, name=label, mode="lines", **group)
    if len(band.values) > 1:
        both = tuple(np.concatenate([axis, axis[::-1]]) for axis in x)
        add(both, np.concatenate([band.high, band.low[::-1]]), fill="toself", mode="lines",
            line={"width": 0}, fillcolor=_fade(color), hoverinfo="skip", showlegend=False,
            legendgroup=label)  # fmt: skip
    if len(band.values) > 1:
        for seed, values in enumerate(band.values):
            add(x, values, mode="lines", line={"color": color, "width": 0.8}, visible="legendonly",
                name=f"seeds of {label}", legendgroup=f"seeds of {label}",
                showlegend=seed == 0)  # fmt: skip


def _thin(band: Band) -> Band:
    """Keep at most `MAX_POINTS` points."""
    every = -(-len(band.env_steps) // MAX_POINTS)
    return Band(*(x[..., ::every] for x in band))


def _fade(color: str) -> str:
    red, green, blue = bytes.fromhex(color[1:])
    return f"rgba({red},{green},{blue},0.18)"


def _cycle(colors: Sequence[str]) -> Any:
    return (colors[i % len(colors)] for i in count())


def draw_usefulness(study: SkillStudy, found: list[Usefulness]) -> go.Figure:
    """Draw the return with each skill held, held by one agent, and removed, with intervals."""
    figure = new_figure(110 + 44 * len(found))
    rows = [letter(entry.level, entry.skill) for entry in found]
    marks = {
        "held by all": ([entry.held for entry in found], "circle", "#0072B2", 0.2),
        "held by one agent": ([entry.one_agent for entry in found], "diamond", "#E69F00", 0.0),
        "removed": ([entry.removed for entry in found], "x", "#D55E00", -0.2),
    }
    for name, (values, symbol, color, shift) in marks.items():
        places = [i + shift for i, value in enumerate(values) if value is not None]
        known: list[Estimate] = [value for value in values if value is not None]
        figure.add_trace(
            go.Scatter(
                x=[e.value for e in known],
                y=places,
                error_x={
                    "type": "data",
                    "array": [e.high - e.value for e in known],
                    "arrayminus": [e.value - e.low for e in known],
                },
                mode="markers",
                marker={"symbol": symbol, "color": color, "size": 9},
                name=name,
                hovertemplate="%{x:.3f}<extra>" + name + "</extra>",
            )
        )
    free = estimate_mean(study.plays[FREE].returns)
    figure.add_vrect(x0=free.low, x1=free.high, fillcolor="#009E73", opacity=0.15, line_width=0)
    figure.add_vline(x=free.value, line={"color": "#009E73", "width": 1.5})
    figure.add_annotation(x=free.value, yref="paper", y=1.0, yanchor="bottom", showarrow=False,
                          text="all skills", font={"color": "#009E73"})  # fmt: skip
    figure.update_xaxes(title="return")
    figure.update_traces(cliponaxis=False)
    ticks = {"tickvals": list(range(len(rows))), "ticktext": rows}
    return figure.update_yaxes(autorange="reversed", **ticks)


def draw_space(space: SkillSpace) -> go.Figure:
    """Draw the inputs of a discriminator, projected on their principal components."""
    name = "q_D: global states" if space.level == "team" else "q_d: observations of one agent"
    figure = new_figure(360, title={"text": name, "font": {"size": 14}, "x": 0.01})
    for row, skill in enumerate(np.unique(space.skills)):
        x, y = space.points[space.skills == skill].T
        label = letter(space.level, int(skill))
        guessed = space.confusion[row, skill]
        figure.add_trace(
            go.Scatter(
                x=x,
                y=y,
                mode="markers",
                name=f"{label} (q = {guessed:.2f})",
                marker={
                    "color": color_of(space.level, int(skill)),
                    "size": 6,
                    "opacity": 0.7,
                    "line": {"width": 0.5, "color": "rgba(160,160,160,0.7)"},
                },
                hovertemplate=label + "<extra></extra>",
            )
        )
    first, second = space.explained
    figure.update_xaxes(title=f"component 1 ({first:.0%} of variance)", showticklabels=False)
    return figure.update_yaxes(title=f"component 2 ({second:.0%})", showticklabels=False)
