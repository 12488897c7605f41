"""Logs of metrics: always JSON lines, and TensorBoard or Weights & Biases on request.

A record is a flat dictionary with `kind` ("train" or "eval"), `seed`, `env_steps`, `wall_seconds`
(training time so far, without compilation) and numbers by name.
"""

import importlib.util
import json
import logging
import math
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from hmasd_jax.runs import durable
from hmasd_jax.runs.folder import RunError, metrics_path, seed_folder
from hmasd_jax.validation import ConfigError, parse_json

Record = dict[str, Any]
NOT_METRICS = {"kind", "seed", "env_steps"}
"""Fields of a record that say where it belongs."""
REMOVED = "metrics.removed.jsonl"
"""File beside the metrics that takes the lines which resuming removes from them."""


class Writer(Protocol):
    """A destination for the records of one seed."""

    def write(self, record: Record) -> None:
        """Write one record."""
        ...

    def sync(self) -> None:
        """Pass on all records; those of files are on disk when this returns."""
        ...

    def close(self) -> None:
        """Finish writing. `write` must not be called afterwards."""
        ...


class JsonLines:
    """A file with one JSON object per line. Each line is flushed at once."""

    def __init__(self, path: Path) -> None:
        """Open the file to append to it."""
        self._file = path.open("a")
        durable.sync_folder(path.parent)

    def write(self, record: Record) -> None:
        """Append a line."""
        self._file.write(json.dumps(record, allow_nan=False) + "\n")
        self._file.flush()

    def sync(self) -> None:
        """Wait until all lines are on disk."""
        durable.sync(self._file)

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

    def sync(self) -> None:
        """Write the buffered scalars."""
        self._writer.flush()

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

    def sync(self) -> None:
        """Do nothing, because a process of its own uploads the records."""

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
                f"uv pip install -c constraints.txt -e '.[{logger}]'"
            )


class Log(NamedTuple):
    """Lines of a file of metrics, each without its line break."""

    records: list[tuple[bytes, Record]]
    """Lines that are records, each with its record."""
    damaged: list[bytes]
    """Lines that are no records."""
    unfinished: bytes
    """Text after the last line break, such as a kill leaves; empty if it is a record."""


def read(path: Path) -> list[Record]:
    """Read the records of a file; an absent file has none.

    Lines that are no records are left out, with a warning.

    Raises:
        RunError: The file cannot be read.
    """
    log = _read_lines(path)
    if told := _tell(path, log):
        _warn(f"{told}; resuming the run moves them to {REMOVED}")
    return [record for _, record in log.records]


def evaluations(records: list[Record]) -> list[Record]:
    """Return the evaluations among the records of a seed, without that of the untrained policy."""
    return [record for record in records if record["kind"] == "eval" and record["env_steps"] > 0]


def find_damage(path: Path) -> str | None:
    """Return the start of a sentence about damaged lines, or None if there are none.

    Raises:
        RunError: The file cannot be read.
    """
    return _tell(path, _read_lines(path))


def keep_until(path: Path, env_steps: int) -> str | None:
    """Move the records after `env_steps`, which resumed training writes again, to another file.

    Lines that are no records move there, too: nothing is lost.

    Returns:
        A sentence about damaged lines, or None if there are none.

    Raises:
        RunError: The file cannot be read.
        OSError: A file cannot be written. `path` is as it was.
    """
    log = _read_lines(path)
    kept = [line for line, record in log.records if record["env_steps"] <= env_steps]
    later = [line for line, record in log.records if record["env_steps"] > env_steps]
    unfinished = [log.unfinished] if log.unfinished else []
    removed = path.with_name(REMOVED)
    if moved := [*log.damaged, *later, *unfinished]:
        with removed.open("ab") as file:
            file.write(b"".join(line + b"\n" for line in moved))
            durable.sync(file)
        durable.sync_folder(removed.parent)
    content = b"".join(line + b"\n" for line in kept)
    if path.exists() and path.read_bytes() != content:
        durable.replace(path, content)
    told = _tell(path, log)
    return f"{told}; they are now in {removed}" if told else None


def _read_lines(path: Path) -> Log:
    """Read a file of metrics."""
    try:
        *lines, end = path.read_bytes().split(b"\n")
    except FileNotFoundError:
        return Log([], [], b"")
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror}; move it away") from error
    records, damaged = [], []
    for line in lines:
        try:
            records.append((line, parse_record(line)))
        except ValueError:
            damaged.append(line)
    with suppress(ValueError):  # A record whose line break alone is missing.
        records.append((end, parse_record(end)))
        end = b""
    return Log(records, damaged, end)


def parse_record(line: bytes) -> Record:
    """Read one line of a file of metrics.

    Raises:
        ValueError: It is not a record.
    """
    record = parse_json(line)
    if not isinstance(record, dict) or not {*NOT_METRICS, "wall_seconds"} <= record.keys():
        raise ValueError("a record has kind, seed, env_steps and wall_seconds")
    if record["kind"] not in ("train", "eval"):
        raise ValueError(f"a record is of kind train or eval, not {record['kind']!r}")
    for name, value in record.items():
        whole = name in NOT_METRICS
        if name != "kind" and not _is_number(value, whole):
            raise ValueError(f"{name} must be a {'whole ' * whole}number, got {value!r}")
    return record


def _is_number(value: Any, whole: bool) -> bool:
    """Tell if a value is a finite float, or an int that fits into 64 bits."""
    if type(value) is int:
        return abs(value) < 2**63
    return type(value) is float and math.isfinite(value) and not whole


def _tell(path: Path, log: Log) -> str | None:
    """Return the start of a sentence about damaged lines, or None if all of them are blank."""
    count = sum(bool(line.strip()) for line in log.damaged)
    if count == 1:
        return f"1 line of {path} is no record of metrics"
    return f"{count} lines of {path} are no records of metrics" if count else None


@lru_cache  # Once for every message, although commands read a file several times.
def _warn(message: str) -> None:
    logging.getLogger(__name__).warning("warning: %s", message)


def _metrics(record: Record) -> Record:
    """Return the numbers of a record under the names `train/<name>` or `eval/<name>`."""
    return {f"{record['kind']}/{k}": v for k, v in record.items() if k not in NOT_METRICS}
