"""Options of every command. They import no JAX, so that the list of commands appears at once."""

import itertools
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from tyro.conf import Positional, arg

from hmasd_jax.cli.vary import split_settings
from hmasd_jax.validation import FASTEST_FPS, SLOWEST_FPS, ConfigError, check_range

IMAGES = (".png", ".pdf", ".svg")
"""Endings of images that curves can be drawn to."""


@dataclass(frozen=True)
class Options:
    """Options of a command; the fields and their docstrings are what its help shows."""

    OLD_NAMES: ClassVar[Mapping[str, str]] = {}
    """Former names of options that are still accepted, with the names they have now."""


@dataclass(frozen=True)
class RunOptions(Options):
    """Files that a run reads and writes."""

    config: Path | None = None
    """A .toml file, a preset of the library such as configs/alice_and_bob/quick.toml, or the
    config.json of a run. The default is the paper's preset."""
    run_dir: Path | None = None
    """Folder to write. The default is a new folder under runs/, named after task and time."""
    resume: bool = False
    """Continue the run in --run-dir from its newest checkpoints."""
    tensorboard: bool = False
    """Also write TensorBoard files (package tensorboardX)."""
    wandb: bool = False
    """Also log to Weights & Biases (package wandb; WANDB_MODE=offline needs no account)."""

    @property
    def base(self) -> Path | None:
        """File of settings that those of the command line change."""
        return self.config

    @property
    def resumed_run(self) -> Path | None:
        """Folder of the run to resume."""
        return self.run_dir if self.resume else None

    @property
    def loggers(self) -> tuple[str, ...]:
        """Names of the optional loggers to use."""
        chosen = {"tensorboard": self.tensorboard, "wandb": self.wandb}
        return tuple(name for name, wanted in chosen.items() if wanted)

    @property
    def repeated(self) -> list[str]:
        """Words that a command repeats when it resumes this run."""
        return [f"--{name}" for name in self.loggers]


@dataclass(frozen=True)
class TrainOptions(RunOptions):
    """Seed to train, and files that the run reads and writes."""

    seed_index: int | None = None
    """Index of the seed to train; its numbers are those of this seed in `seed_sweep`. By default
    that of a resumed run with a single seed, else 0."""

    def __post_init__(self) -> None:
        if self.seed_index is not None:
            check_range(self, "seed_index", low=0)  # Larger indices belong to keys of evaluations.

    @property
    def repeated(self) -> list[str]:
        """Words that a command repeats when it resumes this run."""
        index = ["--seed-index", str(self.seed_index)] if self.seed_index else []
        return [*super().repeated, *index]


@dataclass(frozen=True)
class SweepOptions(RunOptions):
    """Files that the sweep reads and writes, and processes that share its work."""

    distributed: bool = False
    """Share the seeds among the processes that this command was started in, by srun, mpirun or the
    environment variables JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID."""

    @property
    def repeated(self) -> list[str]:
        """Words that a command repeats when it resumes this run."""
        return [*super().repeated, *(["--distributed"] if self.distributed else [])]


@dataclass(frozen=True)
class GridOptions(RunOptions):
    """Settings to vary, and files that the sweeps read and write."""

    vary: Annotated[tuple[str, ...], arg(metavar="NAME=VALUES")] = ()
    """A setting and its values, e.g. algorithm.skill_interval=5,10,25,50. Repeat it to try every
    combination. Each has a run folder of its own in --run-dir."""

    @property
    def resumed_run(self) -> None:
        """None, because each cell has a run folder and a configuration of its own."""

    @property
    def cells(self) -> list[dict[str, str]]:
        """Combinations of the values, each a dictionary by dotted name of the setting.

        Raises:
            ConfigError: An entry of `vary` is not of the form NAME=VALUE,VALUE, or two name the
                same setting.
        """
        settings = split_settings(self.vary or ("",))
        for _, values in settings:
            for value in values:
                if not value.isprintable() or "/" in value or os.sep in value:
                    raise ConfigError(
                        f"--vary: {value!r} cannot name a folder; give it in a TOML file"
                    )
        names, values = zip(*settings)
        return [dict(zip(names, cell)) for cell in itertools.product(*values)]


@dataclass(frozen=True)
class TuneOptions(RunOptions):
    """Settings to search, and files that the search reads and writes."""

    run_dir: Path | None = None
    """Folder of the search. Its trials are run folders in it. Processes that name the same folder
    share the trials."""
    resume: bool = False
    """Continue or join the search in --run-dir; what is not given is as it was."""
    vary: Annotated[tuple[str, ...], arg(metavar="NAME=VALUES")] = ()
    """A setting with its range, e.g. algorithm.low_entropy_coef=0.01:0.1:log, or with its values,
    e.g. algorithm.skill_interval=5,10,25. Repeat it to search several settings at once."""
    trials: int | None = None
    """Number of trials of all processes together, the preset included. The default is 20."""
    last: int | None = None
    """Number of last evaluations whose mean is the score of a seed. The default is 5."""
    prune_after: int | None = None
    """Trials that must be complete before worse ones are stopped early. The default is 5."""
    storage: str | None = None
    """Storage of Optuna, e.g. postgresql://host/db. The default is a file in the folder."""
    study_name: str | None = None
    """Name of the search in --storage. The default is the name of the folder."""

    def __post_init__(self) -> None:
        for name in ("trials", "last", "prune_after"):
            if getattr(self, name) is not None:
                check_range(self, name, low=0 if name == "prune_after" else 1)
        if self.storage is not None and "://" not in self.storage:
            raise ConfigError(
                f"--storage must be a URL such as sqlite:///search.db, got {self.storage!r}"
            )

    @property
    def resumed_run(self) -> None:
        """None, because a search has a preset, and each trial a configuration of its own."""

    @property
    def base(self) -> Path | None:
        """File of settings that those of the command line change."""
        if self.config is not None or not self.resume or self.run_dir is None:
            return self.config
        preset = self.run_dir / "preset.json"
        if not preset.is_file():
            raise ConfigError(f"{self.run_dir} is not a search: it has no preset.json")
        return preset


@dataclass(frozen=True)
class EvaluateOptions(Options):
    """Policies to evaluate, and episodes to play."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of a finished or running run."""
    episodes: int | None = None
    """Episodes per seed. The default is the number of the run's own evaluations."""
    sampled: bool = False
    """Sample skills and actions, as in training, instead of taking the most probable ones."""
    step: int | None = None
    """Environment steps of the checkpoints. The default is the newest of each seed."""

    def __post_init__(self) -> None:
        if self.episodes is not None:
            check_range(self, "episodes", low=1)


@dataclass(frozen=True)
class RenderOptions(Options):
    """Episodes to draw."""

    OLD_NAMES: ClassVar[Mapping[str, str]] = {"seed": "seed_index"}

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of a finished or running run."""
    out: Path = Path("episode.gif")
    """Animation to write, .gif or .mp4."""
    seed_index: int = 0
    """Index of the run's seed to draw. Its former name --seed still works."""
    team_skill: int | None = None
    """Team skill Z to hold throughout. By default the coordinator chooses."""
    episodes: int = 1
    """Number of episodes to draw, one after the other."""
    fps: float = 5.0
    """Environment steps per second, from 0.1 to 100."""
    step: int | None = None
    """Environment steps of the checkpoint. The default is the newest."""

    def __post_init__(self) -> None:
        check_range(self, "episodes", low=1)
        check_range(self, "seed_index", low=0)
        check_range(self, "fps", low=SLOWEST_FPS, high=FASTEST_FPS)


@dataclass(frozen=True)
class PlotOptions(Options):
    """Runs to plot."""

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN [RUN ...]")]
    """Folders of runs. Each run is one curve with a band over its seeds."""
    out: Path = Path("curves.png")
    """Image to write, .png, or .pdf or .svg for print. Its numbers go beside it as CSV."""
    metric: str | None = None
    """Metric of the evaluations, e.g. success, return or length. The default is success if all runs
    have it, else return."""
    show_seeds: bool = False
    """Also draw a thin line per seed."""

    def __post_init__(self) -> None:
        if self.out.suffix not in IMAGES:
            raise ConfigError(f"--out must end in {', '.join(IMAGES)}; got {self.out}")


@dataclass(frozen=True)
class CompareOptions(PlotOptions):
    """Runs to compare."""

    out: Path = Path("comparison.png")
    """Image to write, .png, or .pdf or .svg for print. Its numbers go beside it as CSV."""
    last: int = 5
    """Number of last evaluations whose mean is the score of a seed."""
    solved_at: float | None = None
    """Score from which a seed has solved the task. The default is a success rate of 0.9, or any
    return above 0."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "last", low=1)
        if self.solved_at is not None:
            check_range(self, "solved_at")


@dataclass(frozen=True)
class ReportOptions(Options):
    """Runs to report."""

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN [RUN ...]")]
    """Folders of finished or running runs. They are only read."""
    out: Path = Path("report.html")
    """Page to write, .html. Its data goes beside it as CSV."""
    episodes: int = 100
    """Episodes per skill and condition."""
    seeds: int = 3
    """Most seeds per run whose skills are played."""
    solved_at: float | None = None
    """Score from which a seed has solved the task. The default is a success rate of 0.9, or any
    return above 0."""
    megabytes: float = 15.0
    """Largest size of the page. Films become shorter to keep it."""
    serve: bool = False
    """Serve the page on this machine instead of writing it: it follows the training, and the agents
    of the first run can be driven (packages starlette and uvicorn)."""
    port: int = 8000
    """Port of the served page; 0 takes a free one."""

    def __post_init__(self) -> None:
        if self.solved_at is not None:
            check_range(self, "solved_at")
        check_range(self, "port", low=0, high=65535)
        check_range(self, "episodes", low=2)
        check_range(self, "seeds", low=0)
        check_range(self, "megabytes", low=6)
