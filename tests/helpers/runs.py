"""Run folders as training writes them, without any training."""

import json
from pathlib import Path

from hmasd_jax import config as configs
from hmasd_jax.runs import checkpoint
from hmasd_jax.runs.folder import checkpoint_folder
from tests.helpers.algorithms import draw_state

STEPS = [0, 100, 200, 300]
"""Environment steps of the evaluations."""


def write_run(
    folder: Path, curves: list[list[float]], metric: str = "success", **overrides
) -> Path:
    """Write a run folder with one seed per curve, evaluated at `STEPS` until its curve ends."""
    folder.mkdir()
    table = configs.to_json(configs.load(None, overrides))
    (folder / "config.json").write_text(json.dumps(table))
    for seed, curve in enumerate(curves):
        (folder / f"seed_{seed}").mkdir()
        records = []
        for step, value in zip(STEPS, curve):
            where = {"seed": seed, "env_steps": step, "wall_seconds": 1.0}
            records.append({"kind": "eval", **where, metric: value, "length": 100 * value})
            train = {"coordinator/team_entropy": 0.5, "discriminators/team_accuracy": value}
            records.append({"kind": "train", **where, **train})
        lines = "".join(json.dumps(record) + "\n" for record in records)
        (folder / f"seed_{seed}" / "metrics.jsonl").write_text(lines)
    return folder


def save_checkpoint(run: Path, seed: int, env_steps: int) -> None:
    """Save a drawn train state as a checkpoint of the run's own configuration."""
    config = configs.load(run / "config.json")
    _, algorithm = configs.build(config)
    state = draw_state(algorithm, seed)
    checkpoint.save(checkpoint_folder(run, seed), env_steps, state, configs.to_json(config), keep=1)
