"""The folder of a run: one layout, however the seeds in it were computed.

RUN/config.json, RUN/run.json, RUN/seed_<i>/metrics.jsonl, RUN/seed_<i>/checkpoints/<env steps>/,
and at the end RUN/summary.json and RUN/curves.png.
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

from hmasd_jax import config as configs
from hmasd_jax.config import TrainConfig

try:
    import fcntl
except ImportError:  # not on Windows: nothing then keeps two processes off one seed
    fcntl = None


class RunError(RuntimeError):
    """A run folder cannot be used as asked; the message is one line that says what to do."""


def seed_folder(run: Path, index: int) -> Path:
    """Everything that belongs to one seed."""
    return run / f"seed_{index}"


def metrics_path(run: Path, index: int) -> Path:
    """One JSON object per line."""
    return seed_folder(run, index) / "metrics.jsonl"


def checkpoint_folder(run: Path, index: int) -> Path:
    """Of one seed."""
    return seed_folder(run, index) / "checkpoints"


def seeds_of(run: Path) -> list[int]:
    """Indices of the seeds that have a folder, ascending."""
    names = [path.name.removeprefix("seed_") for path in run.glob("seed_*")]
    return sorted(int(name) for name in names if name.isdigit())


def read_config(run: Path) -> TrainConfig:
    """The resolved configuration of a run.

    Raises:
        RunError: `run` is not the folder of a run.
        ConfigError: its configuration is not valid any more.
    """
    if not (run / "config.json").is_file():
        raise RunError(f"{run} is not a run folder: it has no config.json")
    return configs.load(run / "config.json")


def create(run: Path, config: TrainConfig, command: list[str]) -> None:
    """Start a new run folder.

    Raises:
        RunError: there is something at `run`, or it cannot be written.
    """
    if run.exists() and (not run.is_dir() or any(run.iterdir())):
        raise RunError(f"{run} exists: continue it with --resume, or choose another --run-dir")
    try:
        run.mkdir(parents=True, exist_ok=True)
        write_json(run / "run.json", describe(command))
        write_json(run / "config.json", configs.to_json(config))
    except OSError as error:
        raise RunError(f"cannot write {run}: {error.strerror}") from error


def note_resume(run: Path, config: TrainConfig, command: list[str]) -> None:
    """Record that and how the run was continued, and in config.json how far it is to go now."""
    record = json.loads((run / "run.json").read_text())
    record.setdefault("resumed", []).append(describe(command))
    write_json(run / "run.json", record)
    write_json(run / "config.json", configs.to_json(config))


def write_json(path: Path, value: Any) -> None:
    """Replace `path` in one step, so that a reader never sees half of it."""
    unfinished = path.with_suffix(".tmp")
    unfinished.write_text(json.dumps(value, indent=2) + "\n")
    unfinished.replace(path)


def describe(command: list[str]) -> dict[str, Any]:
    """What a result can depend on beside the configuration."""
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
    """Processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


@contextmanager
def lock(run: Path, index: int) -> Iterator[None]:
    """Hold one seed for this process; the system lets go of it however the process ends.

    Raises:
        RunError: another process is training it.
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
    """Commit of the checkout that this package runs from, `+` marking uncommitted changes."""
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
    """How this program is started with `arguments`."""
    return [Path(sys.executable).name, "-m", "hmasd_jax.train", *arguments]
