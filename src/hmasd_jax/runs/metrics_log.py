"""Where metrics go: JSON lines always, TensorBoard and Weights & Biases if asked for.

A record is a flat dictionary with `kind` ("train" or "eval"), `seed`, `env_steps`,
`wall_seconds` (of training so far, compilation excluded) and numbers by name.
"""

import importlib.util
import json
from pathlib import Path
from typing import Any, Protocol

from hmasd_jax.runs import folder as run_folder
from hmasd_jax.validation import ConfigError

Record = dict[str, Any]
NOT_METRICS = {"kind", "seed", "env_steps"}


class Writer(Protocol):
    """Takes the records of one seed."""

    def write(self, record: Record) -> None:
        """Keep one record."""
        ...

    def close(self) -> None:
        """Finish; nothing is written afterwards."""
        ...


class JsonLines:
    """One JSON object per line; every line is handed to the system at once."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a")

    def write(self, record: Record) -> None:
        """Append a line."""
        self._file.write(json.dumps(record, allow_nan=False) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class TensorBoard:
    """Scalars as `train/<name>` and `eval/<name>` over environment steps."""

    def __init__(self, folder: Path, resumed_at: int) -> None:
        from tensorboardX import SummaryWriter

        self._writer = SummaryWriter(str(folder), purge_step=resumed_at + 1)

    def write(self, record: Record) -> None:
        """Add every number of the record."""
        for name, value in _metrics(record).items():
            self._writer.add_scalar(name, value, record["env_steps"])

    def close(self) -> None:
        """Write what is still buffered."""
        self._writer.close()


class WeightsAndBiases:
    """One W&B run per seed, grouped by run folder; `WANDB_MODE=offline` needs no account."""

    def __init__(self, run: Path, seed: int, config: dict) -> None:
        import wandb  # pyrefly: ignore (an optional package)

        self._run = wandb.init(
            dir=str(run_folder.seed_folder(run, seed)),
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
        """Upload the rest."""
        self._run.finish()


def open_writers(
    run: Path, seed: int, config: dict, resumed_at: int, extras: tuple[str, ...]
) -> list[Writer]:
    """Writers of one seed, going on after `resumed_at` environment steps (-1: from nothing)."""
    writers: list[Writer] = [JsonLines(run_folder.metrics_path(run, seed))]
    if "tensorboard" in extras:
        folder = run_folder.seed_folder(run, seed) / "tensorboard"
        writers.append(TensorBoard(folder, resumed_at))
    if "wandb" in extras:
        writers.append(WeightsAndBiases(run, seed, config))
    return writers


def check_extras(extras: tuple[str, ...]) -> None:
    """Insist that the optional packages asked for are installed.

    Raises:
        ConfigError: one is not.
    """
    packages = {"tensorboard": "tensorboardX", "wandb": "wandb"}
    for extra in extras:
        if importlib.util.find_spec(packages[extra]) is None:
            raise ConfigError(
                f"--{extra} needs the package {packages[extra]}, which is not installed: "
                f"pip install 'hmasd-jax[{extra}]'"
            )


def read(path: Path) -> list[Record]:
    """All whole records of a file; a line that a kill cut short is left out."""
    records = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            records.append(json.loads(line))
        except ValueError:
            break
    return records


def keep_until(path: Path, env_steps: int) -> None:
    """Drop the records after `env_steps`: training goes on from there and writes them again."""
    if not path.exists():
        return
    kept = [record for record in read(path) if record["env_steps"] <= env_steps]
    unfinished = path.with_suffix(".tmp")
    unfinished.write_text("".join(json.dumps(record) + "\n" for record in kept))
    unfinished.replace(path)


def _metrics(record: Record) -> Record:
    """Numbers of a record, by names that tell training from evaluation."""
    return {f"{record['kind']}/{k}": v for k, v in record.items() if k not in NOT_METRICS}
