"""Results of a search, in words and as a table."""

from collections import Counter
from typing import TYPE_CHECKING

from rich.table import Table

from hmasd_jax.runs.folder import is_run
from hmasd_jax.search.score import read_evaluations
from hmasd_jax.search.space import value_of
from hmasd_jax.search.study import Search, trial_folder
from hmasd_jax.search.trials import best
from hmasd_jax.training.schedule import make_plan

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

STATES = {
    "COMPLETE": "complete",
    "PRUNED": "stopped early",
    "FAIL": "failed",
    "RUNNING": "in training or interrupted",
}
"""States of Optuna's trials, in our words."""


def count_states(search: Search) -> str:
    """Return a sentence with the number of trials in each state."""
    counts = Counter(trial.state.name for trial in search.study.get_trials(deepcopy=False))
    parts = [f"{counts[state]} {words}" for state, words in STATES.items() if counts[state]]
    return f"{search.trials} trials: {', '.join(parts) or 'none begun'}"


def compare_best(search: Search) -> Table | None:
    """Return a table of the best trial beside the preset; None if no trial is complete."""
    found, preset = best(search), preset_trial(search)
    if found is None:
        return None
    config = search.definition.config
    table = Table("", "preset (trial 0)", f"best (trial {found.number})")
    for name in search.space:
        own = value_of(config, name)
        table.add_row(name, write_value(own), write_value(found.params.get(name, own)))
    table.add_section()
    score = f"{found.value:.3f}"
    own_score = f"{preset.value:.3f}" if preset and preset.value is not None else "not yet"
    table.add_row(describe_score(search), own_score, score)
    if found.number:
        table.caption = (
            "The best of many trials looks better than it is: confirm it with fresh seeds."
        )
    return table


def write_value(value: object) -> str:
    """Write a value with as many digits as matter."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def describe_score(search: Search) -> str:
    """Say what the score of a trial is."""
    config = search.definition.config
    last = min(search.definition.last, make_plan(config).num_evaluations - 1)
    counted = f"mean of the last {last} evaluations" if last > 1 else "last evaluation"
    numbers = (trial.number for trial in search.study.get_trials(deepcopy=False))
    folders = (trial_folder(search.folder, number) for number in numbers)
    run = next(filter(is_run, folders), None)  # Others may be on other machines.
    metric = "score" if run is None else read_evaluations(run, config.num_seeds)[0]
    seeds = f"{config.num_seeds} seeds" if config.num_seeds > 1 else "one seed"
    return f"{metric}, {counted} of {seeds}"


def preset_trial(search: Search) -> "FrozenTrial | None":
    """Return trial 0, if it is complete."""
    trials = search.study.get_trials(deepcopy=False)
    zero = next((trial for trial in trials if trial.number == 0), None)
    return zero if zero is not None and zero.state.name == "COMPLETE" else None
