"""`python -m hmasd_jax.train COMMAND`: the command line."""

import os
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

from envs_jax.registry import ENVIRONMENTS
from hmasd_jax import config
from hmasd_jax.algorithms import ALGORITHMS
from hmasd_jax.cli import options as arguments
from hmasd_jax.config import ConfigError
from hmasd_jax.validation import suggest


class Command(NamedTuple):
    """One word of the command line."""

    summary: str
    options: type
    positional: str | None
    """Option that takes words without a name; None for commands that take settings."""


COMMANDS = {
    "train": Command("Train one seed.", arguments.TrainOptions, None),
    "seed_sweep": Command(
        "Train several seeds of one experiment; without arguments, the paper's HMASD on "
        "Alice_and_Bob.",
        arguments.SweepOptions,
        None,
    ),
    "grid": Command(
        "Train several seeds for each value of one setting, e.g. --vary "
        "algorithm.num_skills=2,3,4,5.",
        arguments.GridOptions,
        None,
    ),
    "evaluate": Command(
        "Play episodes with the newest checkpoint of every seed of a run.",
        arguments.EvaluateOptions,
        "run",
    ),
    "render": Command("Draw an episode as a GIF.", arguments.RenderOptions, "run"),
    "plot": Command("Plot learning curves of runs.", arguments.PlotOptions, "runs"),
    "compare": Command(
        "Compare runs on one task: curves, and statistics over seeds with intervals.",
        arguments.CompareOptions,
        "runs",
    ),
}


def main(words: list[str] | None = None) -> int:
    """Run the command line `words` (those of the process if None); the exit code."""
    words = sys.argv[1:] if words is None else words
    wants_help = any(word in ("-h", "--help") for word in words)
    words = [word for word in words if word not in ("-h", "--help")]
    if not words:
        print(usage())
        return 0 if wants_help else 2
    name, rest = words[0], words[1:]
    try:
        if name not in COMMANDS:
            raise ConfigError(f"unknown command {name!r}{suggest(name, COMMANDS)}")
        return _help(name, rest) if wants_help else _run(name, rest)
    except ConfigError as error:
        return _complain(error)
    except BrokenPipeError:  # the reader has seen enough, as in `--help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def usage() -> str:
    """What the commands are."""
    lines = [f"  {name:<11} {command.summary}" for name, command in COMMANDS.items()]
    head = "usage: python -m hmasd_jax.train COMMAND [--help] [OPTIONS]"
    return "\n".join([head, "", *lines])


def _help(name: str, words: list[str]) -> int:
    command = COMMANDS[name]
    if command.positional:
        arguments.write_help(name, command.summary, command.options, None)
        return 0
    options, overrides = arguments.parse(command.options, words)
    summary = (
        f"{command.summary} --env.name is one of {', '.join(ENVIRONMENTS)}; --algorithm.name is "
        f"one of {', '.join(ALGORITHMS)}. Values shown are those that the rest of the command "
        "line gives."
    )
    settings = config.load(options.config, overrides)
    arguments.write_help(name, summary, command.options, settings)
    return 0


def _run(name: str, words: list[str]) -> int:
    command = COMMANDS[name]
    options, overrides = arguments.parse(command.options, words, command.positional)
    if command.positional:
        arguments.refuse_overrides(command.options, overrides)
        from hmasd_jax.cli import inspect_commands as inspection

        action: Callable[..., int] = getattr(inspection, name)
        return _guarded(action, options)
    if options.resume and options.run_dir is None:
        raise ConfigError("--resume needs --run-dir, the folder of the run to continue")
    saved = options.saved_config
    if saved and not saved.is_file():
        raise ConfigError(f"{options.run_dir} is not a run folder: it has no config.json")
    settings = config.load(options.config or saved, overrides)
    from hmasd_jax.cli import train_commands as experiment

    return _guarded(getattr(experiment, name), settings, options, words)


def _guarded(action: Callable[..., int], *args: Any) -> int:
    """Run `action`; what the user can mend is told in one line."""
    from envs_jax.optional import MissingPackageError
    from hmasd_jax.runs.checkpoint import CheckpointError
    from hmasd_jax.runs.folder import RunError

    try:
        return action(*args)
    except (RunError, CheckpointError, MissingPackageError) as error:
        return _complain(error)
    except OSError as error:  # above all a full disk
        print(f"error: {error}; what was saved before stays usable", file=sys.stderr)
        return 1


def _complain(error: Exception) -> int:
    print(f"error: {error}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
