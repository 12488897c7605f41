"""Files and clock of one seed in training."""

import time
from contextlib import suppress
from typing import Any

from hmasd_jax.config import to_json
from hmasd_jax.runs import checkpoint, metrics_log
from hmasd_jax.runs.folder import checkpoint_folder, metrics_path
from hmasd_jax.training.job import Event, Job


class SeedRun:
    """One seed of a run: its checkpoints, its metrics and its result."""

    def __init__(self, job: Job, index: int) -> None:
        """Open nothing yet."""
        self.job, self.index = job, index
        self.config = to_json(job.config)
        self.checkpoints = checkpoint_folder(job.run, index)
        self.writers: list[metrics_log.Writer] = []
        self.started_at = 0.0
        """Time of `perf_counter`, moved back by the seconds that earlier processes trained."""
        self.result: Event | None = None
        """The last event, once the seed has ended."""

    def open(self, env_steps: int) -> None:
        """Open the files to train from `env_steps`; records of later steps are moved away."""
        path = metrics_path(self.job.run, self.index)
        resumed_at = env_steps or -1
        if message := metrics_log.keep_until(path, resumed_at):
            self.report("note", message=message)
        records = metrics_log.read(path)
        self.writers = metrics_log.open_writers(
            self.job.run, self.index, self.config, resumed_at, self.job.loggers
        )
        self.started_at = time.perf_counter() - (records[-1]["wall_seconds"] if records else 0.0)

    def report(self, kind: str, **data: Any) -> None:
        """Report an event of this seed."""
        self.job.report(Event(kind, self.index, data))

    def write(self, kind: str, env_steps: int, metrics: dict[str, float]) -> None:
        """Write one record to all logs and report it.

        Args:
            kind: `train` or `eval`.
            env_steps: Environment steps done.
            metrics: Numbers by name.
        """
        own = {
            "kind": kind,
            "seed": self.index,
            "env_steps": env_steps,
            "wall_seconds": round(time.perf_counter() - self.started_at, 3),
        }
        record = own | metrics | own  # An environment's info must not replace a field.
        for writer in self.writers:
            writer.write(record)
        self.job.report(Event(kind, self.index, record))

    def save(self, env_steps: int, state: Any) -> None:
        """Save a checkpoint of this seed's train state, after the metrics up to it.

        The other way round, a power cut may leave a checkpoint whose metrics are lost, and nothing
        would train them again.
        """
        for writer in self.writers:
            writer.sync()
        keep = self.job.config.keep_checkpoints
        checkpoint.save(self.checkpoints, env_steps, state, self.config, keep)

    def restore(self, template: Any, env_steps: int) -> Any:
        """Return the train state that was saved after `env_steps`."""
        return checkpoint.restore(self.checkpoints, template, self.config, env_steps)[0]

    def end(self, kind: str, **data: Any) -> None:
        """Close the files and report the last event. Later calls do nothing."""
        if self.result is None:
            self.result = Event(kind, self.index, data)
            for writer in self.writers:
                with suppress(OSError):  # a full disk was already reported when writing
                    writer.close()
            self.job.report(self.result)

    def fail(self, reason: str) -> None:
        """End because of an error in training; the message names the newest checkpoint."""
        step = checkpoint.latest_step(self.checkpoints)
        good = (
            "none was saved"
            if step is None
            else str(checkpoint.checkpoint_path(self.checkpoints, step))
        )
        self.end("failed", message=f"{reason}; last good checkpoint: {good}")
