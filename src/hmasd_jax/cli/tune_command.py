"""The command `tune`: a search whose trials are ordinary runs."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
from rich.console import Console

from hmasd_jax.analysis.learning import LAST
from hmasd_jax.cli import summary
from hmasd_jax.cli.hints import suggest_next, write_command
from hmasd_jax.cli.options import SweepOptions, TuneOptions
from hmasd_jax.cli.train_commands import (
    FAILED,
    INTERRUPTED,
    create_default_folder,
    exit_code,
    run_seeds,
)
from hmasd_jax.cli.vary import split_settings
from hmasd_jax.config import ConfigError, TrainConfig, build, change
from hmasd_jax.runs.folder import is_run
from hmasd_jax.runs.metrics_log import check_loggers
from hmasd_jax.search import trials
from hmasd_jax.search.space import count, preset_values, read_space
from hmasd_jax.search.storage import needs_storage
from hmasd_jax.search.study import (
    Definition,
    Search,
    create_or_join,
    read_search,
    suggest_values,
    trial_folder,
)
from hmasd_jax.search.tables import compare_best, count_states
from hmasd_jax.training.loop import choose_placement
from hmasd_jax.training.signals import stop_on_signal
from hmasd_jax.training.workers import worker_cores

if TYPE_CHECKING:
    from optuna import Trial

TRIALS, PRUNE_AFTER = 20, 5
"""Defaults of options whose value a resumed search remembers; another is `LAST`."""


def tune(config: TrainConfig, options: TuneOptions, words: list[str]) -> int:
    """Create, join or continue a search, train its trials and return the exit code."""
    check_loggers(options.loggers)
    build(config)  # Before anything is written: settings may not fit.
    search = open_search(config, options)
    console = Console()
    code = 0
    with stop_on_signal() as should_stop, needs_storage(search.folder):
        while not should_stop() and code != INTERRUPTED:
            with trials.next_trial(search) as trial:
                if trial is None:
                    break
                code = run_trial(search, trial, options, console)
        interrupted = should_stop() or code == INTERRUPTED
    return conclude(search, console, options, interrupted)


def open_search(config: TrainConfig, options: TuneOptions) -> Search:
    """Open the search that a command line asks for.

    Raises:
        RunError: The folder is no search, or another one.
        ConfigError: The space is not valid, or smaller than the number of trials.
    """
    saved = None
    if options.resume and options.run_dir is not None:
        saved = read_search(options.run_dir, options.storage)
    old = saved.definition if saved else None
    number = _first(options.trials, saved and saved.trials, TRIALS)
    definition = Definition(
        config=config,
        settings=split_settings(options.vary) or (old.settings if old else []),
        last=_first(options.last, old and old.last, LAST),
        prune_after=_first(options.prune_after, old and old.prune_after, PRUNE_AFTER),
    )
    space = read_space(config, definition.settings)
    possible = count(space) + (preset_values(config, space) is None)
    if number > possible:
        raise ConfigError(
            f"trials {number} is more than the {possible} combinations of --vary: lower it to at "
            "most that, or use grid"
        )
    folder = options.run_dir or create_default_folder(config)
    return create_or_join(folder, definition, number, options.storage, options.study_name)


def _first(*values: Any) -> Any:
    return next(value for value in values if value is not None)


def run_trial(search: Search, trial: "Trial", options: TuneOptions, console: Console) -> int:
    """Train one trial, or continue it, and record how it ends; return its exit code."""
    values = suggest_values(search, trial)
    shown = ", ".join(f"{name}={value}" for name, value in values.items()) or "the preset"
    say(console, f"\ntrial {trial.number} of {search.trials}: {shown}")
    try:
        config = change(search.definition.config, values)
        build(config)
    except ConfigError as error:
        return _fail(search, trial, str(error), console)
    if twin := trials.find_twin(search, trial):
        trials.repeat(search, trial, twin)
        say(console, f"trial {trial.number} has the values and so the score of trial {twin.number}")
        return 0
    placement, num_seeds = choose_placement(config), config.num_seeds
    at_once = len(worker_cores(num_seeds)) if placement == "workers" else num_seeds
    pruner = trials.Pruner(search, trial, config, at_once)
    run = trial_folder(search.folder, trial.number)
    sweep = SweepOptions(
        run_dir=run, resume=is_run(run), tensorboard=options.tensorboard, wandb=options.wandb
    )
    words = _command(search, values, run)
    try:
        results = run_seeds(config, sweep, words, list(range(num_seeds)), placement, watcher=pruner)
    except jax.errors.JaxRuntimeError as error:  # Most often, too little memory.
        return _fail(search, trial, str(error).splitlines()[0], console)
    summary.write(run, results)
    code = 0 if pruner.pruned else exit_code(results)
    if pruner.pruned:
        trials.prune(search, trial)
        say(console, f"trial {trial.number} stopped early: it has fallen behind")
    elif code == 0:
        score = pruner.score()
        trials.complete(search, trial, score)
        say(console, f"trial {trial.number} has score {score:.3f}")
        summary.plot(console, run)
    elif code == FAILED:
        failed = {i: e.data["message"] for i, e in sorted(results.items()) if e.kind == "failed"}
        reason = "; ".join(f"seed {seed}: {message}" for seed, message in failed.items())
        return _fail(search, trial, reason, console)
    return code


def _command(search: Search, values: dict[str, Any], run: Path) -> list[str]:
    """Return the words of the command that makes the run of a trial alone."""
    changes = [str(word) for name, value in values.items() for word in (f"--{name}", value)]
    preset = ["--config", str(search.folder / "preset.json")]
    return ["seed_sweep", *preset, *changes, "--run-dir", str(run)]


def _fail(search: Search, trial: "Trial", reason: str, console: Console) -> int:
    trials.fail(search, trial, reason)
    say(console, f"trial {trial.number} failed: {reason}")
    return FAILED


def say(console: Console, text: str) -> None:
    """Print a line as it is."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def conclude(search: Search, console: Console, options: TuneOptions, interrupted: bool) -> int:
    """Print the best trial beside the preset and the next command; return the exit code."""
    folder = str(search.folder)
    say(console, f"\nsearch           {folder}\n{count_states(search)}")
    table, best = compare_best(search), trials.best(search)
    if table is not None:
        console.print(table)
    if interrupted:
        again = write_command("tune", "--run-dir", folder, "--resume", *options.repeated)
        say(console, f"interrupted; to continue: {again}")
        return INTERRUPTED
    if best is None:
        return FAILED
    run = trial_folder(search.folder, best.number)
    if best.number == 0 or not is_run(run):  # Another machine may have it.
        suggest_next("report", folder)
        return 0
    seed = search.definition.config.seed + 1
    fresh = ["--seed", seed, "--num-seeds", 10, "--run-dir", f"{folder}_best"]
    suggest_next("seed_sweep", "--config", run / "config.json", *fresh)
    return 0
