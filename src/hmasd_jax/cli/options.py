"""The command line as options and overrides. Everything here is fast: nothing of jax runs.

tyro writes the help out of types and docstrings. Parsing is done here, so that a mistake on the
command line gets the same one line as the same mistake in a TOML file.
"""

import contextlib
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import tyro
from tyro.conf import Positional
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from hmasd_jax.config import TrainConfig
from hmasd_jax.config.from_table import Flag, Text, from_table
from hmasd_jax.validation import ConfigError, check_range, suggest

Options = TypeVar("Options")


@dataclass(frozen=True)
class RunOptions:
    """Where a run reads from and writes to."""

    config: Path | None = None
    """A .toml file, or the config.json of a run; without it, the paper's preset."""
    run_dir: Path | None = None
    """Folder to write; without it, a new one under runs/ named after the task and the time."""
    resume: bool = False
    """Continue the run in --run-dir from its newest checkpoints."""
    tensorboard: bool = False
    """Write TensorBoard files too (package tensorboardX)."""
    wandb: bool = False
    """Log to Weights & Biases too (package wandb; WANDB_MODE=offline needs no account)."""

    @property
    def saved_config(self) -> Path | None:
        """The configuration of the run to resume."""
        return self.run_dir / "config.json" if self.resume and self.run_dir else None


@dataclass(frozen=True)
class SweepOptions(RunOptions):
    """Where a run reads from and writes to, and what shares the work."""

    distributed: bool = False
    """Share the seeds among the processes that this command was started in, by srun, mpirun or the
    environment variables JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID."""


@dataclass(frozen=True)
class GridOptions(RunOptions):
    """Which setting to vary, and where the sweeps read from and write to."""

    vary: str = ""
    """A setting and its values, e.g. algorithm.skill_interval=5,10,25,50. Each value is a run of
    its own in --run-dir."""

    @property
    def saved_config(self) -> None:
        """Each value has its own."""

    @property
    def cells(self) -> tuple[str, list[str]]:
        """The setting's dotted name, and its values.

        Raises:
            ConfigError: `vary` is not written as it should be.
        """
        name, equals, values = self.vary.partition("=")
        found = [value.strip() for value in values.split(",")]
        if not (name and equals and all(found)) or len(set(found)) < len(found):
            raise ConfigError(
                "--vary must name a setting and its values, each once, as in "
                f"algorithm.skill_interval=5,10,25: got {self.vary!r}"
            )
        return name.strip().replace("-", "_"), found


@dataclass(frozen=True)
class TrainOptions(RunOptions):
    """Where a run reads from and writes to, and which seed it is."""

    seed_index: int = 0
    """Which seed of a sweep to run: the same numbers as that seed of `seed_sweep`."""

    def __post_init__(self) -> None:
        check_range(self, "seed_index", low=0)


@dataclass(frozen=True)
class EvaluateOptions:
    """Which policies to play, and how often."""

    run: Annotated[Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Folder of a finished or running run."""
    episodes: int | None = None
    """Episodes per seed; without it, as many as in the run's own evaluations."""
    sampled: bool = False
    """Sample skills and actions, as in training, instead of taking the most likely ones."""

    def __post_init__(self) -> None:
        if self.episodes is not None:
            check_range(self, "episodes", low=1)


@dataclass(frozen=True)
class RenderOptions:
    """Which episode to draw."""

    run: Annotated[Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Folder of a finished or running run."""
    out: Path
    """GIF to write."""
    seed: int = 0
    """Which seed of the run."""
    team_skill: int | None = None
    """Team skill to hold throughout; without it, the coordinator chooses."""
    episodes: int = 1
    """Episodes to draw, one after the other."""
    fps: float = 5.0
    """Environment steps per second."""
    step: int | None = None
    """Environment steps of the checkpoint; without it, the newest."""

    def __post_init__(self) -> None:
        check_range(self, "episodes", low=1)
        check_range(self, "seed", "fps", low=0)


@dataclass(frozen=True)
class PlotOptions:
    """What to plot."""

    runs: Annotated[Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN [RUN ...]")]
    """Folders of runs; each is one curve with a band over its seeds."""
    out: Path = Path("curves.png")
    """Image to write."""
    metric: str = "success"
    """Which number of the evaluations, e.g. success, return or length."""


@dataclass(frozen=True)
class CompareOptions(PlotOptions):
    """What to compare."""

    out: Path = Path("comparison.png")
    """Image to write."""
    last: int = 5
    """Evaluations at the end that the score of a seed is the mean of."""
    solved_at: float = 0.9
    """Score from which on a seed counts as one that learned."""

    def __post_init__(self) -> None:
        check_range(self, "last", low=1)


def parse(
    cls: type[Options], arguments: Sequence[str], positional: str | None = None
) -> tuple[Options, dict[str, Text]]:
    """Split a command line into the options of a command and overrides of the configuration.

    Args:
        cls: options of the command.
        arguments: what follows the command.
        positional: field of `cls` that takes words without a name.

    Returns:
        The options, and all other `--name value` pairs by dotted name, for `config.load`.

    Raises:
        ConfigError: a word in a wrong place, or an option's value of a wrong type.
    """
    hints = get_type_hints(cls)
    given: dict[str, Any] = {}
    overrides: dict[str, Text] = {}
    words = list(arguments)
    while words:
        word = words.pop(0)
        if word.startswith("--"):
            name, equals, value = word[2:].partition("=")
            name = name.replace("-", "_")
            if not equals:
                is_flag = not words or words[0].startswith("--") or hints.get(name) is bool
                value = Flag("true") if is_flag else Text(words.pop(0))
                if not is_flag and name not in hints and positional is None:
                    value = _as_list(value, words)
            else:
                value = Text(value)
            (given if name in hints else overrides)[name] = value
        elif positional is None:
            raise ConfigError(f"unexpected {word!r}: settings are written --name value")
        elif hints[positional] == tuple[Path, ...]:
            given[positional] = (*given.get(positional, ()), Text(word))
        elif positional in given:
            raise ConfigError(f"unexpected {word!r}: {given[positional]} is given already")
        else:
            given[positional] = Text(word)
    return from_table(cls, given), overrides


def _as_list(value: Text, words: list[str]) -> Text:
    """`value`, or the list of it and of the words that follow it without a name."""
    values = [value]
    while words and not words[0].startswith("--"):
        values.append(Text(words.pop(0)))
    return value if len(values) == 1 else Text(f"[{', '.join(values)}]")


def drop_options(words: Sequence[str], *names: str) -> list[str]:
    """The words of a command line without the named options and their values."""
    kept: list[str] = []
    dropping = False
    for word in words:
        if word.startswith("--"):
            dropping = word[2:].partition("=")[0].replace("_", "-") in names
        if not dropping:
            kept.append(word)
    return kept


def refuse_overrides(cls: type, overrides: dict[str, Text]) -> None:
    """For commands that take no settings.

    Raises:
        ConfigError: there are some.
    """
    for name in overrides:
        known = [f.name for f in dataclasses.fields(cls)]
        raise ConfigError(f"unknown option --{name}{suggest(name, known)}")


def write_help(command: str, summary: str, cls: type, settings: TrainConfig | None) -> None:
    """Print the help of a command: its options, and settings with their current values."""
    no_prefix = tyro.conf.arg(name="")
    fields: list[Any] = [("options", Annotated[tyro.conf.FlagCreatePairsOff[cls], no_prefix])]
    required = {f.name: tyro.MISSING for f in dataclasses.fields(cls) if _is_required(f)}
    defaults: dict[str, Any] = {"options": cls(**required)}
    if settings is not None:
        types = TrainConfig[type(settings.env), type(settings.algorithm)]  # pyrefly: ignore
        fields.append(("settings", Annotated[tyro.conf.FlagConversionOff[types], no_prefix]))
        defaults["settings"] = settings
    arguments = dataclasses.make_dataclass("Arguments", fields, frozen=True)
    with contextlib.suppress(SystemExit), _named_objects():
        tyro.cli(
            arguments,
            default=arguments(**defaults),
            args=["--help"],
            prog=f"python -m hmasd_jax.train {command}",
            description=summary,
        )


def _named_objects() -> ConstructorRegistry:
    """Explains what is a name or an object, as a scenario, by its name only."""
    registry = ConstructorRegistry()

    @registry.primitive_rule
    def by_name(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        if str not in get_args(info.type):
            return None
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar="NAME",
            instance_from_str=lambda words: words[0],
            is_instance=lambda value: isinstance(value, str),
            str_from_instance=lambda value: [value],
        )

    return registry


def _is_required(option: dataclasses.Field) -> bool:
    return option.default is option.default_factory is dataclasses.MISSING
