"""The folder of a run. It has the same files in every layout of the seeds.

- `config.json`: the resolved configuration.
- `run.json`: commands, commit, versions and hardware.
- `seed_<i>/metrics.jsonl`: the records of training and evaluation.
- `seed_<i>/checkpoints/<env steps>.npz`: the newest checkpoints.
- `summary.json` and `curves.png`, at the end of the run.
"""

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hmasd_jax.config import TrainConfig, load, to_json

try:
    import fcntl
except ImportError:  # Windows, where two processes are then able to train the same seed
    fcntl = None


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
    names = [path.name.removeprefix("seed_") for path in run.glob("seed_*")]
    return sorted(int(name) for name in names if name.isdigit())


def read_config(run: Path) -> TrainConfig:
    """Read the resolved configuration of a run.

    Raises:
        RunError: `run` is not the folder of a run.
        ConfigError: The configuration is not valid in this version.
    """
    if not (run / "config.json").is_file():
        raise RunError(f"{run} is not a run folder: it has no config.json")
    return load(run / "config.json")


def create(run: Path, config: TrainConfig, command: list[str]) -> None:
    """Create a new run folder.

    Args:
        run: Path of the folder. An empty folder may exist there.
        config: Configuration to write to `config.json`.
        command: Words of the command line to record in `run.json`.

    Raises:
        RunError: The path is in use or cannot be written.
    """
    if run.exists() and (not run.is_dir() or any(run.iterdir())):
        raise RunError(f"{run} exists: continue it with --resume, or choose another --run-dir")
    try:
        run.mkdir(parents=True, exist_ok=True)
        write_json(run / "run.json", describe(command))
        write_json(run / "config.json", to_json(config))
    except OSError as error:
        raise RunError(f"cannot write {run}: {error.strerror}") from error


def note_resume(run: Path, config: TrainConfig, command: list[str]) -> None:
    """Add the command to `run.json`, and write the configuration, which may be a longer run."""
    record = json.loads((run / "run.json").read_text())
    record.setdefault("resumed", []).append(describe(command))
    write_json(run / "run.json", record)
    write_json(run / "config.json", to_json(config))


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically, so that a reader never sees half of it."""
    unfinished = path.with_suffix(".tmp")
    unfinished.write_text(json.dumps(value, indent=2) + "\n")
    unfinished.replace(path)


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
    folder = seed_folder(run, index)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as file:
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise RunError(f"another process is training {folder}: wait for it") from error
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


def shell_command(arguments: list[str]) -> list[str]:
    """Return the words of the command that starts this program with `arguments`."""
    return [Path(sys.executable).name, "-m", "hmasd_jax.train", *arguments]
