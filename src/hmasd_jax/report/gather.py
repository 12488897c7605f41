"""Data of one run for a report: settings, records, and a study of each trained seed."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from hmasd_jax.analysis.learning import (
    Band,
    Learned,
    bands,
    read_records,
    summarize,
)
from hmasd_jax.analysis.skills import Player, SkillStudy, Track, make_player, study_skills
from hmasd_jax.config import identity, to_json
from hmasd_jax.config.presets import find_preset
from hmasd_jax.runs import metrics_log
from hmasd_jax.runs.checkpoint import CheckpointError
from hmasd_jax.runs.folder import RunError, metrics_path, read_config
from hmasd_jax.runs.load import TrainedRun, load_run
from hmasd_jax.runs.metrics_log import Record


class Setting(NamedTuple):
    """One resolved setting."""

    name: str
    value: Any
    preset: Any
    """Value in the preset; None without a preset."""
    differs: bool


class Seed(NamedTuple):
    """One trained seed."""

    index: int
    trained: TrainedRun
    study: SkillStudy


class Run(NamedTuple):
    """One run of a report."""

    path: Path
    label: str
    """Name in legends."""
    task: str
    algorithm: str
    settings: list[Setting]
    preset: str | None
    """Name of the preset that settings are compared with."""
    about: dict[str, Any]
    """The run's `run.json`."""
    records: dict[int, list[Record]]
    metric: str
    """Name of the score in the evaluations."""
    learned: Learned | None
    evaluation: dict[str, Band]
    training: dict[str, Band]
    seeds: list[Seed]
    lacks: list[str]
    """Sentences about what the run does not have."""


def gather(
    path: Path,
    label: str,
    metric: str,
    episodes: int,
    num_seeds: int,
    solved_at: float,
    track: Track,
) -> Run:
    """Read a run and play its newest checkpoints; the folder is only read.

    Args:
        path: Folder of the run.
        label: Name in legends.
        metric: Name of the score in the evaluations.
        episodes: Episodes per condition of `study_skills`.
        num_seeds: Most seeds to study.
        solved_at: Score from which a seed has solved the task.
        track: Wrapper of the loops, e.g. a progress bar.

    Raises:
        RunError: `path` is not the folder of a run, or its metrics are damaged.
        ConfigError: The configuration of the run is not valid in this version.
    """
    records = read_records(path)
    table = to_json(read_config(path))
    seeds, lacks = study_seeds(path, list(records), episodes, num_seeds, track)
    preset = find_preset(table)
    about, no_about = _read_json(path / "run.json")
    summary, no_summary = _read_json(path / "summary.json")
    return Run(
        path=path,
        label=label,
        task=_task_name(table["env"]),
        algorithm=table["algorithm"]["name"],
        settings=compare_settings(identity(table), preset[1] if preset else None),
        preset=preset[0] if preset else None,
        about=about,
        records=records,
        metric=metric,
        learned=summarize(records, metric, solved_at),
        evaluation=bands(records, "eval"),
        training=bands(records, "train"),
        seeds=seeds,
        lacks=[*_lacking_records(path, records, summary), *lacks, *no_about, *no_summary],
    )


def study_seeds(
    path: Path, seeds: Iterable[int], episodes: int, num_seeds: int, track: Track
) -> tuple[list[Seed], list[str]]:
    """Study the first `num_seeds` seeds that have a checkpoint, and say why others are left out."""
    studied: list[Seed] = []
    lacks: list[str] = []
    player: Player | None = None
    left: list[int] = []
    for index in seeds:
        if len(studied) == num_seeds:
            left.append(index)
            continue
        try:
            trained = load_run(path, index)
        except (CheckpointError, RunError) as error:
            lacks.append(f"Seed {index} has no skills to show: {error}.")
            continue
        player = player or make_player(trained, episodes)
        studied.append(Seed(index, trained, study_skills(trained, player, track)))
    if left:
        which = ", ".join(map(str, left))
        lacks.append(f"Skills of seeds {which} are not shown: ask for them with --seeds.")
    return studied, lacks


def compare_settings(own: dict[str, Any], preset: dict[str, Any] | None) -> list[Setting]:
    """Return all settings by dotted name, those that differ from the preset first."""
    found = [
        Setting(name, value, preset.get(name), preset.get(name) != value)
        if preset is not None
        else Setting(name, value, None, False)
        for name, value in own.items()
        if name != "seed"
    ]
    return sorted(found, key=lambda setting: not setting.differs)


def _task_name(env: dict[str, Any]) -> str:
    """Return the environment's name with its scenario or layout, if that is a name."""
    part = env.get("scenario", env.get("layout"))
    known = isinstance(part, str) and "\n" not in part
    return f"{env['name']} {part}" if known else env["name"]


def _read_json(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Return a table, empty if there is no such file, and a sentence if it cannot be read."""
    try:
        table = json.loads(path.read_text())
    except FileNotFoundError:
        return {}, []
    except (OSError, ValueError):
        return {}, [f"{path.name} cannot be read."]
    return (table, []) if isinstance(table, dict) else ({}, [f"{path.name} is no table."])


def _lacking_records(
    path: Path, records: dict[int, list[Record]], summary: dict[str, Any]
) -> list[str]:
    """Say which seeds have no evaluation, and which ones failed."""
    lacks = [
        f"Seed {seed} has no evaluation yet."
        for seed, rows in records.items()
        if not any(row["kind"] == "eval" for row in rows)
    ]
    lacks += ["The run has no seed yet."] * (not records)
    damages = (metrics_log.find_damage(metrics_path(path, seed)) for seed in records)
    lacks += [f"{damage}." for damage in damages if damage]
    for seed, end in summary.get("seeds", {}).items():
        if end.get("status") == "failed":
            lacks.append(f"Seed {seed} failed: {end.get('message', 'without a message')}.")
    return lacks
