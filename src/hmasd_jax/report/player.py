"""One episode to step through: the film, and the skills of the team and of each agent below it."""

from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from envs_jax import Environment
from envs_jax.declared import describe_agents
from hmasd_jax.analysis.episodes import Episode
from hmasd_jax.analysis.skills import Level
from hmasd_jax.report.charts import GRID, color_of, letter, new_figure
from hmasd_jax.report.media import picture_uri

MAX_FRAMES = 100
"""Most frames; of longer episodes every second, third, .. step is shown."""
ROW, GAP, BELOW = 26, 14, 150
"""Heights of a row of the timeline, the gap above it, and all below it, in pixels."""


TIMELINE = {"xaxis": "x2", "yaxis": "y2"}
"""Axes of the traces below the film."""


def draw_player(
    env: Environment,
    episode: Episode,
    frames: list[NDArray[np.uint8]],
    frame_times: list[int],
    frame_budget: int,
) -> tuple[go.Figure, int]:
    """Return a figure whose slider and play button move film and timeline together.

    Args:
        env: Environment of the episode.
        episode: The episode.
        frames: Pictures of its states, the first and the last included.
        frame_times: Step of each picture.
        frame_budget: Most frames to show.

    Returns:
        The figure, and the number of steps between two frames.
    """
    every = -(-len(frames) // min(MAX_FRAMES, frame_budget))
    kept = sorted({*range(0, len(frames), every), len(frames) - 1})
    times = [frame_times[index] for index in kept]
    height, width = frames[0].shape[:2]
    rows = ["return"]
    if episode.skills is not None:
        rows = [*[name for name, _ in describe_agents(env)][::-1], "team", "return"]
    timeline = ROW * len(rows)
    plot = height + GAP + timeline
    figure = new_figure(plot + BELOW, showlegend=True)
    images = [picture_uri(frames[index], 70) for index in kept]
    figure.add_trace(go.Image(source=images[0], hoverinfo="skip", xaxis="x", yaxis="y"))
    figure.add_trace(_cursor(0, len(rows)))
    for trace in _bars(episode, rows):
        figure.add_trace(trace)
    figure.add_trace(_return_line(episode, len(rows)))
    figure.frames = [
        go.Frame(name=str(t), data=[go.Image(source=image), _cursor(t, len(rows))], traces=[0, 1])
        for t, image in zip(times, images)
    ]
    _arrange(figure, rows, (width, height), times[-1], timeline / plot)
    below = -50 / plot  # Paper coordinates: 0 is the time axis.
    figure.update_layout(
        sliders=[_slider(times) | {"y": below}],
        updatemenus=[_buttons() | {"y": below}],
        legend={"orientation": "h", "y": -110 / plot, "x": 0, "yanchor": "top"},
    )
    return figure, times[1] - times[0] if len(times) > 1 else 1


def _cursor(time: int, rows: int) -> go.Scatter:
    return go.Scatter(
        x=[time, time],
        y=[-0.6, rows - 0.4],
        mode="lines",
        line={"color": "#D62728", "width": 2},
        hoverinfo="skip",
        showlegend=False,
        **TIMELINE,
    )


def _bars(episode: Episode, rows: list[str]) -> list[go.Bar]:
    """Return one trace per skill, with a bar for each stretch of time in which it is followed."""
    if episode.skills is None:
        return []
    stretches: dict[tuple[Level, int], list[tuple[int, int, int]]] = {}
    for token, column in enumerate(episode.skills.T):
        level: Level = "individual" if token else "team"
        row = len(rows) - 2 - token  # The team is below the return, then come the agents.
        edges = np.flatnonzero(np.diff(column)) + 1
        for start, end in zip([0, *edges], [*edges, len(column)]):
            stretch = (row, int(start), int(end))
            stretches.setdefault((level, int(column[start])), []).append(stretch)
    order = sorted(stretches, key=lambda key: (key[0] != "team", key[1]))
    return [_bar(*key, np.array(stretches[key])) for key in order]


def _bar(level: Level, skill: int, stretches: NDArray[np.integer]) -> go.Bar:
    """Return the bars of one skill from rows of (row, start, end)."""
    places, starts, ends = stretches.T
    name = letter(level, skill)
    return go.Bar(
        y=places,
        base=starts,
        x=ends - starts,
        orientation="h",
        width=0.7,
        name=name,
        marker={
            "color": color_of(level, skill),
            "line": {"width": 1, "color": "rgba(255,255,255,0.6)"},
        },
        customdata=np.stack([starts, ends - 1], axis=1),
        hovertemplate="steps %{customdata[0]} to %{customdata[1]}<extra>" + name + "</extra>",
        **TIMELINE,
    )


def _return_line(episode: Episode, rows: int) -> go.Scatter:
    """Return the return so far, scaled to the height of a row."""
    total = np.concatenate([[0.0], np.cumsum(episode.rewards)])
    spread = max(float(np.ptp(total)), 1e-9)
    return go.Scatter(
        x=np.arange(len(total)),
        y=rows - 1 + 0.7 * ((total - total.min()) / spread - 0.5),
        mode="lines",
        line={"color": "#009E73", "width": 2, "shape": "hv"},
        customdata=total,
        hovertemplate="return %{customdata:.3g}<extra></extra>",
        showlegend=False,
        **TIMELINE,
    )


def _arrange(
    figure: go.Figure, rows: list[str], size: tuple[int, int], steps: int, share: float
) -> None:
    """Put the film above the timeline, which takes a share of the height."""
    width, height = size
    film_bottom = share + (1 - share) * GAP / (height + GAP)
    film: dict[str, Any] = {"visible": False, "fixedrange": True}
    time: dict[str, Any] = {"fixedrange": True, "zeroline": False, "automargin": True}
    title = {"text": "environment step", "standoff": 4}
    figure.update_layout(
        barmode="overlay",
        margin={"l": 10, "r": 10, "t": 10, "b": BELOW - 10},
        xaxis={**film, "range": [0, width], "anchor": "y"},
        yaxis={**film, "range": [height, 0], "anchor": "x", "domain": [film_bottom, 1]},
        xaxis2={**time, "range": [0, steps], "anchor": "y2", "gridcolor": GRID, "title": title},
        yaxis2={
            **time,
            "range": [-0.6, len(rows) - 0.4],
            "domain": [0, share],
            "anchor": "x2",
            "showgrid": False,
            "tickvals": list(range(len(rows))),
            "ticktext": rows,
        },
    )
    figure.update_yaxes(scaleanchor="x", constrain="domain", selector={"anchor": "x"})


def _slider(times: list[int]) -> dict[str, Any]:
    still = {
        "mode": "immediate",
        "frame": {"duration": 0, "redraw": True},
        "transition": {"duration": 0},
    }
    return {
        "steps": [
            {"method": "animate", "label": str(time), "args": [[str(time)], still]}
            for time in times
        ],
        "x": 0.16,
        "len": 0.84,
        "pad": {"t": 14, "b": 0},
        "currentvalue": {"visible": False},
        "font": {"size": 1, "color": "rgba(0,0,0,0)"},
        "ticklen": 0,
        "minorticklen": 0,
        "bgcolor": "rgba(128,128,128,0.3)",
        "bordercolor": GRID,
    }


def _buttons() -> dict[str, Any]:
    play = {
        "frame": {"duration": 180, "redraw": True},
        "transition": {"duration": 0},
        "fromcurrent": True,
    }
    stop = {"mode": "immediate", "frame": {"duration": 0, "redraw": False}}
    return {
        "type": "buttons",
        "direction": "left",
        "buttons": [
            {"label": "▶", "method": "animate", "args": [None, play]},
            {"label": "❚❚", "method": "animate", "args": [[None], stop]},
        ],
        "showactive": False,
        "x": 0,
        "xanchor": "left",
        "yanchor": "top",
        "pad": {"t": 10},
        "bgcolor": "rgba(128,128,128,0.15)",
        "bordercolor": GRID,
    }
