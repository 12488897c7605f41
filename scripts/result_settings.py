"""Settings of recorded results beside those of today's presets."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hmasd_jax.config import TrainConfig, from_json, identity, load, rename, to_json
from scripts.records import ROOT

ROOT_OF_NUMBER = "2026-11-29T23:32"
"""Time of commit b7c915c, from which the exploration bonus pays a feature for all values that it
passes, divided by the root of their number."""


def preset_of(record: Mapping[str, Any]) -> Path:
    """Return the preset that the command of a record names, or the one that commands begin with."""
    config = re.search(r"--config (\S+)", record["command"])
    return ROOT / (config[1] if config else "configs/alice_and_bob/hmasd.toml")


def changed_settings(
    record: Mapping[str, Any], overrides: Mapping[str, Any] | None = None
) -> dict[str, tuple[Any, Any]]:
    """Return the settings of a record that its preset has with another value today.

    Each comes with the recorded value and the preset's. Seeds, the number of steps and the interval
    of checkpoints, which are not the preset's choice, and settings that no longer exist are left
    out. A setting that did not exist at the time has its default.

    Args:
        record: record of a run.
        overrides: settings by dotted name that replace those of the preset.
    """
    preset = load(preset_of(record), dict(overrides or {}))
    recorded = from_json(_known(rename(record["config"]), to_json(preset)))
    old, new = _compared(recorded), _compared(preset)
    return {name: (old[name], new[name]) for name in new if old[name] != new[name]}


def pays_otherwise(record: Mapping[str, Any]) -> bool:
    """Return whether the exploration bonus of a record pays otherwise than today's.

    No setting tells: a commit changed what the bonus pays for. The start of a run tells, since no
    result of an earlier commit has been recorded from then on.
    """
    bonus = record["config"]["algorithm"].get("frontier", {"coef": 0.0})
    return bonus["coef"] > 0.0 and record["started"] < ROOT_OF_NUMBER


def _known(table: Mapping[str, Any], model: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a table, at any depth, whose names `model` has, too."""
    return {
        name: _known(value, model[name]) if isinstance(model[name], Mapping) else value
        for name, value in table.items()
        if name in model
    }


def _compared(config: TrainConfig) -> dict[str, Any]:
    """Return by dotted name what is compared, with what depends on other settings spelled out."""
    settings = identity(to_json(config))
    del settings["seed"], settings["checkpoint_interval"]
    if settings["env.name"] == "micro_battle" and settings["env.state"] is None:
        settings["env.state"] = settings["env.observation"]
    if settings.get("algorithm.frontier.period", 0) >= config.env.max_steps:
        settings["algorithm.frontier.period"] = 0  # No episode is that long.
    for name in ("algorithm.frontier.patience", "algorithm.frontier.pair_coef"):
        if settings.get(name) and settings["env.name"] != "overcooked":
            settings[name] = 0  # No return is above 1.
    return settings
