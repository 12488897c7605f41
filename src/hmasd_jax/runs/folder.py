"""The folder of a run. It has the same files in every placement of the seeds.

- `config.json`: the resolved configuration.
- `run.json`: commands, commit, versions and hardware.
- `seed_<i>/metrics.jsonl`: the records of training and evaluation.
- `seed_<i>/checkpoints/<env steps>.npz`: the newest checkpoints.
- `summary.json`, `curves.png` and its numbers `curves.csv`, at the end of the run.
"""

import json
import logging
import os
import platform
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hmasd_jax.config import (
    ConfigError,
    TrainConfig,
    from_json,
    override,
    read_table,
    subtable,
    to_json,
)
from hmasd_jax.runs import durable
from hmasd_jax.validation import parse_index

try:
    import fcntl
except ImportError:  # Windows, where two processes are then able to train the same seed
    fcntl = None


LOCK = ".lock"
"""File that a process holds while it trains a seed, or changes files of a whole run or search."""


class RunError(RuntimeError):
    """A run folder cannot be used as asked; the message is one line with the remedy."""


def seed_folder(run: Path, index: int) -> Path:
    """Return the folder with all files of one seed."""
    return run / f"seed_{index}"


def metrics_path(run: Path, index: int) -> Path:
    """Return the file of one seed's metrics, which has one JSON object per line."""
    return seed_folder(run, index) / "metrics.jsonl"


def checkpoint_folder(run: Path, index: int) -> Path:
    """Return the folder of one seed's checkpoints."""
    return seed_folder(run, index) / "checkpoints"


def seeds_of(run: Path) -> list[int]:
    """Return the indices of the seeds that have a folder, in ascending order."""
    folders = [path for path in run.glob("seed_*") if path.is_dir()]
    indices = [parse_index(path.name.removeprefix("seed_")) for path in folders]
    return sorted(index for index in indices if index is not None)


def read_config(run: Path, overrides: Mapping[str, Any] | None = None) -> TrainConfig:
    """Read the resolved configuration of a run.

    Args:
        run: Folder of the run.
        overrides: Values by dotted name that win over those of the run.

    Raises:
        RunError: `run` is not the folder of a run.
        ConfigError: The configuration is damaged or not valid in this version.
    """
    path = run / "config.json"
    if not path.is_file():
        if (run / "study.json").is_file():
            raise RunError(f"{run} is a search: name one of its trials, e.g. {run / 'trial_0'}")
        raise RunError(f"{run} is not a run folder: it has no config.json")
    saved = read_table(path)
    if not all("name" in subtable(saved, name) for name in ("env", "algorithm")):
        raise ConfigError(
            f"{path} is damaged: it does not name env and algorithm; restore it from a copy, or "
            "from the entry `config` of a checkpoint"
        )
    return from_json(override(saved, overrides or {}))


def create(run: Path, config: TrainConfig, command: list[str]) -> None:
    """Create a new run folder.

    Args:
        run: Path of the folder. It may exist if it is empty, or if its creation was cut short.
        config: Configuration to write to `config.json`.
        command: Words of the command line to record in `run.json`.

    Raises:
        RunError: The path is in use or cannot be written.
    """
    try:
        check_unused(run)
        record = describe(command)
        run.mkdir(parents=True, exist_ok=True)
        with exclusive(run / LOCK):
            check_unused(run)  # Another process may have created it in the meantime.
            write_json(run / "run.json", record)
            write_json(run / "config.json", to_json(config))  # The last: with it, this is a run.
    except OSError as error:
        raise RunError(f"cannot write {run}: {error.strerror}") from error


def is_run(folder: Path) -> bool:
    """Tell whether a folder is that of a run, whose creation was not cut short."""
    return (folder / "config.json").exists()


def check_unused(run: Path) -> None:
    """Check that a new run can have this path.

    Raises:
        RunError: It cannot; the message says why.
    """
    other = "choose another --run-dir"
    if is_run(run):
        raise RunError(f"{run} exists: continue it with --resume, or {other}")
    if run.is_dir() and {path.name for path in run.glob("[!.]*")} - {"run.json"}:
        raise RunError(f"{run} is not empty, and not a run folder: {other}")
    if run.exists() and not run.is_dir():
        raise RunError(f"{run} is a file: {other}")


def note_resume(run: Path, config: TrainConfig, command: list[str]) -> None:
    """Add the command to `run.json`, and write the configuration, which may be a longer run.

    If `run.json` is damaged, a copy of it is kept.
    """
    path, now = run / "run.json", describe(command)
    with exclusive(run / LOCK):  # Another process may resume another seed.
        try:
            record = _read_record(path)
        except ConfigError as error:
            copy = path.with_name("run.damaged.json")
            path.replace(copy)
            logging.getLogger(__name__).warning("warning: %s; it is now %s", error, copy)
            record = {}
        write_json(path, record | {"resumed": [*record.get("resumed", []), now]})
        write_json(run / "config.json", to_json(config))


def _read_record(path: Path) -> dict[str, Any]:
    """Read `run.json`, which is empty if it is absent.

    Raises:
        ConfigError: It is damaged.
    """
    record = read_table(path) if path.exists() else {}
    if not isinstance(record.get("resumed", []), list):
        raise ConfigError(f"{path} is damaged: resumed must be a list")
    return record


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically, so that a reader never sees half of it."""
    durable.replace(path, f"{json.dumps(value, indent=2)}\n".encode())


def describe(command: list[str]) -> dict[str, Any]:
    """Return what a result can depend on beside the configuration: versions and hardware."""
    import jax

    device = jax.devices()[0]
    return {
        "command": command,
        "commit": _commit(),
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "python": platform.python_version(),
        **{
            name: version(name) for name in ("hmasd_jax", "jax", "jaxlib", "flax", "optax", "numpy")
        },
        "device": f"{device.platform}: {device.device_kind}",
        "num_devices": jax.device_count(),
        "cpu": _cpu_model(),
        "cores": len(available_cores()),
        "platform": platform.platform(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def available_cores() -> list[int]:
    """Return the processor cores that this process may use, in ascending order."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


@contextmanager
def lock(run: Path, index: int) -> Iterator[None]:
    """Lock one seed for this process. The system releases the lock when the process ends.

    Raises:
        RunError: Another process is training the seed.
    """
    path = seed_lock(run, index)
    path.parent.mkdir(parents=True, exist_ok=True)
    with hold(path) as is_held:
        if not is_held:
            raise RunError(f"another process is training {path.parent}: wait for it")
        yield


def seed_lock(run: Path, index: int) -> Path:
    """Return the lock file that the process which trains a seed holds."""
    return seed_folder(run, index) / LOCK


def check_unlocked(run: Path, indices: list[int]) -> None:
    """Check that no other process is training one of the seeds.

    Raises:
        RunError: One is.
    """
    for index in indices:
        if seed_lock(run, index).exists():
            with lock(run, index):
                pass


@contextmanager
def hold(path: Path) -> Iterator[bool]:
    """Hold a lock file if no other process does, and yield whether this one does."""
    with path.open("w") as file:
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            is_held = True
        except BlockingIOError:
            is_held = False
        yield is_held


@contextmanager
def exclusive(path: Path) -> Iterator[None]:
    """Wait until no other process holds this lock file, and hold it.

    Raises:
        OSError: The file cannot be written.
    """
    with path.open("w") as file:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _commit() -> str | None:
    """Return the commit of the checkout of this package, with `+` if there are changes."""
    here = Path(__file__).parent
    git = ["git", "-C", str(here)]
    try:
        subprocess.run(
            [*git, "ls-files", "--error-unmatch", __file__], check=True, capture_output=True
        )
        head = subprocess.run(
            [*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True
        )
        dirty = subprocess.run(
            [*git, "status", "--porcelain", "-uno"], capture_output=True, text=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return head.stdout.strip() + ("+" if dirty.stdout.strip() else "")


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor()
