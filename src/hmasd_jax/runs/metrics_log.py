"""Logs of metrics: always JSON lines, and TensorBoard or Weights & Biases on request.

A record is a flat dictionary with `kind` ("train" or "eval"), `seed`, `env_steps`, `wall_seconds`
(training time so far, without compilation) and numbers by name.
"""

import importlib.util
import json
from pathlib import Path
from typing import Any, Protocol

from hmasd_jax.runs.folder import metrics_path, seed_folder
from hmasd_jax.validation import ConfigError

Record = dict[str, Any]
NOT_METRICS = {"kind", "seed", "env_steps"}
"""Fields of a record that say where it belongs."""


class Writer(Protocol):
    """A destination for the records of one seed."""

    def write(self, record: Record) -> None:
        """Write one record."""
        ...

    def close(self) -> None:
        """Finish writing. `write` must not be called afterwards."""
        ...


class JsonLines:
    """A file with one JSON object per line. Each line is flushed at once."""

    def __init__(self, path: Path) -> None:
        """Open the file to append to it."""
        self._file = path.open("a")

    def write(self, record: Record) -> None:
        """Append a line."""
        self._file.write(json.dumps(record, allow_nan=False) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class TensorBoard:
    """TensorBoard scalars `train/<name>` and `eval/<name>` over environment steps."""

    def __init__(self, folder: Path, resumed_at: int) -> None:
        """Open a log, and hide the records after `resumed_at` environment steps."""
        from tensorboardX import SummaryWriter

        self._writer = SummaryWriter(str(folder), purge_step=resumed_at + 1)

    def write(self, record: Record) -> None:
        """Add every number of the record as a scalar."""
        for name, value in _metrics(record).items():
            self._writer.add_scalar(name, value, record["env_steps"])

    def close(self) -> None:
        """Write the buffered scalars and close the file."""
        self._writer.close()


class WeightsAndBiases:
    """One run of Weights & Biases per seed, grouped by run folder.

    With `WANDB_MODE=offline` it needs no account.
    """

    def __init__(self, run: Path, seed: int, config: dict) -> None:
        """Start the run."""
        import wandb  # pyrefly: ignore (an optional package)

        self._run = wandb.init(
            dir=str(seed_folder(run, seed)),
            group=run.name,
            name=f"{run.name}/seed_{seed}",
            config=config,
            reinit="create_new",
        )
        self._run.define_metric("env_steps")
        self._run.define_metric("*", step_metric="env_steps")

    def write(self, record: Record) -> None:
        """Log every number of the record."""
        self._run.log({"env_steps": record["env_steps"], **_metrics(record)})

    def close(self) -> None:
        """Upload the remaining records."""
        self._run.finish()


def open_writers(
    run: Path, seed: int, config: dict, resumed_at: int, loggers: tuple[str, ...]
) -> list[Writer]:
    """Open all logs of one seed.

    Args:
        run: Folder of the run.
        seed: Index of the seed.
        config: Configuration of the run, of JSON types.
        resumed_at: Environment steps done before; -1 for a new seed.
        loggers: Loggers beside the JSON lines, any of `tensorboard` and `wandb`.
    """
    writers: list[Writer] = [JsonLines(metrics_path(run, seed))]
    if "tensorboard" in loggers:
        folder = seed_folder(run, seed) / "tensorboard"
        writers.append(TensorBoard(folder, resumed_at))
    if "wandb" in loggers:
        writers.append(WeightsAndBiases(run, seed, config))
    return writers


def check_loggers(loggers: tuple[str, ...]) -> None:
    """Check that the optional packages of the loggers are installed.

    Raises:
        ConfigError: A package is missing.
    """
    packages = {"tensorboard": "tensorboardX", "wandb": "wandb"}
    for logger in loggers:
        if importlib.util.find_spec(packages[logger]) is None:
            raise ConfigError(
                f"--{logger} needs the package {packages[logger]}, which is not installed: "
                f"pip install 'hmasd-jax[{logger}]'"
            )


def read(path: Path) -> list[Record]:
    """Read all records of a file up to the first incomplete line, which a kill may have left."""
    records = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            records.append(json.loads(line))
        except ValueError:
            break
    return records


def keep_until(path: Path, env_steps: int) -> None:
    """Delete the records after `env_steps`. Resumed training writes them again."""
    if not path.exists():
        return
    kept = [record for record in read(path) if record["env_steps"] <= env_steps]
    unfinished = path.with_suffix(".tmp")
    unfinished.write_text("".join(json.dumps(record) + "\n" for record in kept))
    unfinished.replace(path)


def _metrics(record: Record) -> Record:
    """Return the numbers of a record under the names `train/<name>` or `eval/<name>`."""
    return {f"{record['kind']}/{k}": v for k, v in record.items() if k not in NOT_METRICS}
