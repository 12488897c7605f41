"""Display of a run in training: live bars in a terminal, plain lines elsewhere."""

import math
import time
from dataclasses import dataclass, field
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from hmasd_jax.training.job import ENDS, Event

SHOWN = {
    "success": "training success {:.0%}",
    "coordinator/team_entropy": "H(Z) {:.2f}",
    "coordinator/skill_entropy": "H(z) {:.2f}",
    "discriminators/team_accuracy": "q_D {:.0%}",
    "discriminators/individual_accuracy": "q_d {:.0%}",
}
"""Metrics to display if the algorithm has them. H is an entropy in nats, q the accuracy of a
discriminator's most probable skill."""
PLAIN_SECONDS = 30.0
"""Shortest time between plain lines with training metrics."""


@dataclass
class Track:
    """Progress of one seed."""

    env_steps: int = 0
    """Environment steps done."""
    first: tuple[int, float] | None = None
    """Environment steps and wall seconds of the first record since the start of this process."""
    rate: float = 0.0
    """Environment steps per second since `first`."""
    train: dict[str, Any] = field(default_factory=dict)
    """The newest record of training."""
    eval: dict[str, Any] = field(default_factory=dict)
    """The newest record of an evaluation."""
    task: TaskID | None = None
    """The bar."""
    ended: bool = False
    """True after the last event."""


class Display:
    """A context manager that displays events."""

    def __init__(self, console: Console, seeds: list[int], total_env_steps: int) -> None:
        """Prepare the display.

        Args:
            console: Console to write to.
            seeds: Indices of the seeds.
            total_env_steps: Environment steps per seed.
        """
        self._console, self._total = console, total_env_steps
        self._tracks = {seed: Track() for seed in seeds}
        self._last_line = time.monotonic()
        self._live = console.is_terminal
        self._compiling = self._compiled = False
        columns = (
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            TextColumn("{task.percentage:>3.0f}%"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[text]}"),
        )
        self._progress = Progress(*columns, console=console, disable=not self._live)
        # Of one seed it would repeat what the seed's own bar says.
        self._all = self._progress.add_task(
            "all", total=total_env_steps * len(seeds), text="", visible=len(seeds) > 1
        )

    def __enter__(self) -> "Display":
        """Start the live display."""
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the live display and leave its last state on the screen."""
        self._progress.stop()

    def handle(self, event: Event) -> None:
        """Update the display with one event."""
        track = self._tracks[event.seed]
        if event.kind == "compiling" and not self._compiling:
            self._compiling = True
            self._print("compiling, which takes minutes at the first start and seconds later")
        elif event.kind == "start":
            self._start(event, track)
        elif event.kind == "note":
            self._print(f"seed {event.seed}: {event.data['message']}")
        elif event.kind == "compiled":
            self._show_compilation(event)
        elif event.kind in ("train", "eval"):
            self._take_record(event, track)
        elif event.kind in ENDS:
            self._end(event, track)
        self._draw(track)

    def _start(self, event: Event, track: Track) -> None:
        track.env_steps = event.data["env_steps"]
        start = f"resuming from env step {track.env_steps:,}" if track.env_steps else "fresh"
        self._print(f"seed {event.seed}: {start}")
        description = f"seed {event.seed}"
        track.task = self._progress.add_task(description, total=self._total, text="compiling")

    def _show_compilation(self, event: Event) -> None:
        if not self._compiled:
            self._compiled = True
            seconds, peak, arrays = (
                event.data[name] for name in ("seconds", "peak_bytes", "memory_bytes")
            )
            self._print(
                f"compiled in {seconds:.0f} s; predicted memory {mebibytes(peak):,} MiB per "
                f"process, of which arrays of the programs {mebibytes(arrays):,} MiB"
            )

    def _take_record(self, event: Event, track: Track) -> None:
        record = event.data
        track.env_steps = record["env_steps"]
        now = (track.env_steps, record["wall_seconds"])
        if track.first is None:
            track.first = now
        elif now[1] > track.first[1]:
            track.rate = (now[0] - track.first[0]) / (now[1] - track.first[1])
        if event.kind == "eval":
            track.eval = record
        else:
            track.train = record
        due = time.monotonic() - self._last_line > PLAIN_SECONDS
        if not self._live and (event.kind == "eval" or due):
            self._last_line = time.monotonic()
            text = f"seed {event.seed}: {track.env_steps:,} env steps, {self._describe(track)}"
            everyone = self._describe_all()
            self._print(text + f"; all seeds {everyone}" * bool(everyone))

    def _end(self, event: Event, track: Track) -> None:
        track.ended = True
        message = event.data.get("message")
        text = f": {message}" if message else f" at env step {track.env_steps:,}"
        self._print(f"seed {event.seed} {event.kind}{text}")
        if track.task is not None:
            self._progress.update(track.task, visible=False)

    def _draw(self, track: Track) -> None:
        done = sum(self._total if t.ended else t.env_steps for t in self._tracks.values())
        self._progress.update(self._all, completed=done, text=self._describe_all())
        if track.task is not None and track.first is not None:
            text = self._describe(track)
            self._progress.update(track.task, completed=track.env_steps, text=text)

    def _describe(self, track: Track) -> str:
        """Return speed, remaining time and metrics of one seed as text."""
        parts = []
        if track.rate:
            remaining = (self._total - track.env_steps) / track.rate
            parts += [f"{track.rate:,.0f}/s", f"ETA {clock(remaining)}"]
        parts += [
            text.format(track.train[name]) for name, text in SHOWN.items() if name in track.train
        ]
        if "success" in track.eval:
            parts.append(f"evaluation {100 * track.eval['success']:.0f} %")
        elif "return" in track.eval:
            parts.append(f"evaluation return {track.eval['return']:.2f}")
        return "  ".join(parts)

    def _describe_all(self) -> str:
        """Return speed and remaining time of all seeds as text, or none if there is one seed."""
        running = [t for t in self._tracks.values() if not t.ended]
        rate = sum(t.rate for t in running)
        if not rate or len(self._tracks) == 1:
            return ""
        remaining = sum(self._total - t.env_steps for t in running) / rate
        return f"{rate:,.0f} env steps/s  ETA {clock(remaining)}"

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)


def mebibytes(size: int) -> int:
    """Return a size in bytes as MiB, rounded up."""
    return math.ceil(size / 2**20)


def clock(seconds: float) -> str:
    """Format a duration as h:mm:ss."""
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{seconds:02}"
