"""Views of a search in a report: Optuna's plots, and the trials beside the preset.

Plotly is imported by the functions that draw, so that a report can tell first if it is missing.
"""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hmasd_jax.runs.folder import RunError, is_run
from hmasd_jax.search.space import value_of
from hmasd_jax.search.study import Search, is_search, read_search, trial_folder
from hmasd_jax.search.tables import STATES, count_states, describe_score, write_value
from hmasd_jax.search.trials import REASON, best

if TYPE_CHECKING:
    import optuna
    import plotly.graph_objects as go

ENOUGH = 4
"""Complete trials from which importances are drawn."""


class SearchView(NamedTuple):
    """A search, ready for the template."""

    name: str
    counts: str
    """Sentence about the number of trials in each state."""
    score: str
    """Sentence about what the score of a trial is."""
    names: list[str]
    """Searched settings."""
    rows: list[tuple[str, str, str, list[str]]]
    """Trial, state, score and values of each trial, the best ones first."""
    history: str
    """Optuna's plot of scores over trials, as HTML."""
    importances: str
    """Optuna's plot of how much each setting matters, as HTML; empty if it cannot be told."""


def expand(runs: Sequence[Path]) -> list[Path]:
    """Replace the folder of each search by those of its preset and its best trial.

    Raises:
        RunError: A search cannot be read, or has no trial that can be shown.
    """
    found: list[Path] = []
    for run in map(Path, runs):
        if not is_search(run):
            found.append(run)
            continue
        leader = best(read_search(run))
        numbers = dict.fromkeys([0, leader.number if leader else 0])
        folders = [trial_folder(run, number) for number in numbers]
        shown = [folder for folder in folders if is_run(folder)]
        if not shown:
            raise RunError(f"{run} has no trial to show yet: wait for the first one")
        found += shown
    return list(dict.fromkeys(found))


def view_searches(runs: Sequence[Path]) -> list[SearchView]:
    """Return the views of those folders that are searches."""
    folders = [Path(run) for run in runs if is_search(Path(run))]
    return [view_search(read_search(f), f"search{i}") for i, f in enumerate(folders)]


def view_search(search: Search, name: str) -> SearchView:
    """Return the view of one search.

    Args:
        search: The search.
        name: Beginning of the ids of its elements, unique on the page.
    """
    from hmasd_jax.report.charts import embed

    study, score = complete_trials(search), describe_score(search)
    importances = draw_importances(study)
    return SearchView(
        name=search.folder.resolve().name,
        counts=count_states(search),
        score=score,
        names=list(search.space),
        rows=list_trials(search),
        history=embed(draw_history(study, score.partition(",")[0]), f"{name}-history"),
        importances=embed(importances, f"{name}-importances") if importances else "",
    )


def complete_trials(search: Search) -> "optuna.Study":
    """Return a study in memory with the complete trials alone."""
    import optuna

    done = search.study.get_trials(states=[optuna.trial.TrialState.COMPLETE])
    study = optuna.create_study(direction="maximize")
    study.add_trials(done)
    return study


def draw_history(study: "optuna.Study", metric: str) -> "go.Figure":
    """Draw the score of each complete trial, and the best one so far."""
    import optuna

    from hmasd_jax.report.charts import RUN_COLORS, dress

    figure = optuna.visualization.plot_optimization_history(study, target_name=metric)
    figure.data = tuple(figure.select_traces(lambda trace: len(trace.x)))
    figure.update_traces(marker_color=RUN_COLORS[0], selector={"mode": "markers"})
    figure.update_traces(line_color=RUN_COLORS[1], name="best so far", selector={"mode": "lines"})
    figure.update_xaxes(title="trial")
    return dress(figure, 340, title=_title("scores of the complete trials"))


def draw_importances(study: "optuna.Study") -> "go.Figure | None":
    """Draw how much of the differences of the score each setting explains.

    Returns:
        The figure; None with too few trials with values, or equal scores.
    """
    import optuna

    from hmasd_jax.report.charts import RUN_COLORS, dress

    valued = [trial for trial in study.trials if trial.params]
    if len(valued) < ENOUGH or len({trial.value for trial in valued}) < 2:
        return None
    own = optuna.create_study(direction="maximize")  # A preset outside the space has no values.
    own.add_trials(valued)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Few trials; the page shows how many there are.
        figure = optuna.visualization.plot_param_importances(own)
    figure.update_traces(marker_color=RUN_COLORS[0])
    figure.update_xaxes(title="", range=[0, 1.25], tickvals=[0, 0.5, 1])
    figure.update_yaxes(title="")
    return dress(figure, 80 + 40 * len(valued[0].params), title=_title("importance of settings"))


def _title(text: str) -> dict[str, Any]:
    return {"text": text, "font": {"size": 14}, "x": 0.01}


def list_trials(search: Search) -> list[tuple[str, str, str, list[str]]]:
    """Return number, state, score and values of each trial, the best ones first."""
    preset = search.definition.config
    trials = [t for t in search.study.get_trials(deepcopy=False) if t.state.name in STATES]

    def rank(trial: Any) -> tuple[bool, float, int]:
        complete = trial.state.name == "COMPLETE"
        return not complete, -(trial.value or 0.0) if complete else 0.0, trial.number

    rows = []
    for trial in sorted(trials, key=rank):
        state = STATES[trial.state.name]
        if reason := trial.user_attrs.get(REASON):
            state = f"{state}: {reason}"
        score = "" if trial.value is None else f"{trial.value:.3f}"
        values = [
            write_value(trial.params.get(n, value_of(preset, n) if trial.number == 0 else ""))
            for n in search.space
        ]
        rows.append((f"{trial.number}{' (preset)' * (trial.number == 0)}", state, score, values))
    return rows
