"""`python -m hmasd_jax.train COMMAND`: the command line.

Nothing here imports JAX before it is known what to run.
"""

import importlib.util
import os
import pkgutil
import sys
from collections.abc import Callable
from typing import NamedTuple

from hmasd_jax.cli.options import (
    CompareOptions,
    EvaluateOptions,
    GridOptions,
    Options,
    PlotOptions,
    RenderOptions,
    ReportOptions,
    RunOptions,
    SweepOptions,
    TrainOptions,
    TuneOptions,
)
from hmasd_jax.cli.wrap import fill
from hmasd_jax.validation import ConfigError


class Command(NamedTuple):
    """One command of the command line."""

    summary: str
    options: type[Options]
    """Its options. Commands with `RunOptions` take settings, too."""
    function: str
    """Function in `hmasd_jax.cli` that runs the command and returns the exit code.

    With `RunOptions` its arguments are the configuration, the options and the words of the command
    line; else the options only.
    """

    def load(self) -> Callable[..., int]:
        """Import the function, and with it what the command needs."""
        return pkgutil.resolve_name(f"hmasd_jax.cli.{self.function}")


COMMANDS = {
    "train": Command("Train one seed.", TrainOptions, "train_commands:train"),
    "seed_sweep": Command(
        "Train several seeds of one experiment; without arguments, the paper's HMASD on "
        "Alice_and_Bob.",
        SweepOptions,
        "train_commands:seed_sweep",
    ),
    "grid": Command(
        "Train several seeds for each combination of values, e.g. --vary "
        "algorithm.num_skills=2,3,4,5.",
        GridOptions,
        "grid_command:grid",
    ),
    "tune": Command(
        "Search good values of settings with Optuna, e.g. --vary "
        "algorithm.low_entropy_coef=0.01:0.1:log.",
        TuneOptions,
        "tune_command:tune",
    ),
    "evaluate": Command(
        "Play episodes with a checkpoint of every seed of a run, by default the newest.",
        EvaluateOptions,
        "inspect_commands:evaluate_checkpoints",
    ),
    "render": Command("Draw episodes as a GIF or MP4.", RenderOptions, "inspect_commands:render"),
    "plot": Command("Plot learning curves of runs.", PlotOptions, "inspect_commands:plot"),
    "compare": Command(
        "Compare runs on one task: curves, and statistics over seeds with intervals.",
        CompareOptions,
        "inspect_commands:compare",
    ),
    "report": Command(
        "Write one HTML page that shows what runs learned: curves, skills, and which matter.",
        ReportOptions,
        "report_command:report",
    ),
}


MEMORY_ADVICE = """the device has too little memory: {}; take fewer copies \
(--algorithm.ppo.num-envs), a smaller replay (--algorithm.q-learning.buffer-size) or fewer seeds \
(--num-seeds), and where programs share a GPU, give each a part (XLA_PYTHON_CLIENT_MEM_FRACTION); \
what was saved before stays usable"""


def main(words: list[str] | None = None) -> int:
    """Run a command line and return the exit code.

    Args:
        words: Words after the program's name; None takes those of this process.
    """
    words = sys.argv[1:] if words is None else words
    _prepare_streams()
    wants_help = any(word in ("-h", "--help") for word in words)
    words = [word for word in words if word not in ("-h", "--help")]
    try:
        if wants_help or not words:
            _print_help(words)
            return 0 if wants_help else 2
        command = _find(words[0])
        from hmasd_jax.cli.parse import load_config, parse

        options, overrides = parse(command.options, words[1:])
        if isinstance(options, RunOptions):
            from hmasd_jax.cli.output import lasting_streams

            config = load_config(options, overrides)
            with lasting_streams():
                return command.load()(config, options, words)
        return command.load()(options)
    except ConfigError as error:
        return _complain(error)
    except _expected_errors() as error:
        return _complain(error)
    except OSError as error:  # Most often a full disk.
        print(f"error: {error}; what was saved before stays usable", file=sys.stderr)
        return 1
    except Exception as error:
        if not _is_out_of_memory(error):
            raise
        print(f"error: {MEMORY_ADVICE.format(str(error).splitlines()[0])}", file=sys.stderr)
        return 1


def _is_out_of_memory(error: Exception) -> bool:
    """Return True if JAX says that a device has too little memory, for arrays or for a library."""
    jax = sys.modules.get("jax")  # `--help` does without it.
    signs = ("RESOURCE_EXHAUSTED", "Failed to initialize BLAS")
    return (
        jax is not None
        and isinstance(error, jax.errors.JaxRuntimeError)
        and any(sign in str(error) for sign in signs)
    )


def _prepare_streams() -> None:
    """Open absent streams to nothing, and keep XLA's false alarms off the screen.

    XLA writes two long lines about SIGILL for each program that it loads from disk, also on the
    machine that compiled it (JAX issue 38445). Errors of accelerators are left to be seen.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # A shell closes it by `>&-`.
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
    accelerators = ("jax_cuda12_plugin", "jax_cuda13_plugin", "jax_rocm7_plugin", "libtpu")
    if not any(importlib.util.find_spec(name) for name in accelerators):
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # JAX reads it when it is imported.


def usage() -> str:
    """Return the list of commands."""
    lines = [fill(f"  {name:<11} {command.summary}", 14) for name, command in COMMANDS.items()]
    head = "usage: python -m hmasd_jax.train COMMAND [--help] [OPTIONS]"
    return "\n".join([head, "", *lines])


def _print_help(words: list[str]) -> None:
    """Print the help of the command in `words`, or the list of commands if there is none."""
    try:
        if words:
            _describe(words[0], words[1:])
        else:
            print(usage())
        sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Drops the rest.
        if not isinstance(error, BrokenPipeError):  # The reader has left, as in `--help | head`.
            raise ConfigError(f"cannot write the help: {error.strerror}") from error


def _describe(name: str, words: list[str]) -> None:
    """Print the help of one command, with the settings that `words` give."""
    command = _find(name)
    from hmasd_jax.cli.help import write_help

    config = None
    if issubclass(command.options, RunOptions):
        from hmasd_jax.cli.parse import load_config, parse

        config = load_config(*parse(command.options, words))
    write_help(name, command.summary, command.options, config)


def _find(name: str) -> Command:
    if name in COMMANDS:
        return COMMANDS[name]
    from envs_jax.choices import suggest

    raise ConfigError(f"unknown command {name!r}{suggest(name, COMMANDS)}")


def _expected_errors() -> tuple[type[Exception], ...]:
    """Import the errors that the user can correct; called when an exception is raised."""
    from envs_jax.optional import MissingPackageError
    from hmasd_jax.runs.checkpoint import CheckpointError
    from hmasd_jax.runs.folder import RunError

    return RunError, CheckpointError, MissingPackageError


def _complain(error: Exception) -> int:
    print(f"error: {error}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
