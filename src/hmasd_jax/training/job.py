"""The order to train a run, and the events that its training reports."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from envs_jax import Environment
from hmasd_jax.config import TrainConfig
from hmasd_jax.types import Algorithm

ENDS = ("finished", "interrupted", "failed")
"""Kinds of the last event of a seed."""


class Event(NamedTuple):
    """News about one seed."""

    kind: str
    """`compiling`, `start`, `note`, `compiled`, `train`, `eval`, or one of `ENDS`."""
    seed: int
    """Index of the seed."""
    data: dict[str, Any]
    """The record of a `train` or `eval` event. Otherwise numbers, or a `message`."""


class Watcher(Protocol):
    """A part that follows a run in training and may end it early."""

    def handle(self, event: Event) -> None:
        """Take note of an event."""
        ...

    def should_stop(self) -> bool:
        """Return True to end the run; what is trained is saved."""
        ...


class Job(NamedTuple):
    """A run folder, the things to train in it, and functions that connect it to the caller."""

    run: Path
    """Folder of the run."""
    config: TrainConfig
    """Configuration of the run."""
    env: Environment
    """Environment that `config` describes."""
    algorithm: Algorithm
    """Algorithm that `config` describes, built once per process."""
    loggers: tuple[str, ...]
    """Loggers beside the JSON lines: any of `tensorboard` and `wandb`."""
    report: Callable[[Event], None]
    """Called with every event."""
    should_stop: Callable[[], bool]
    """Asked between stretches of updates. If it returns True, training saves and returns."""
