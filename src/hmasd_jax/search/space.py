"""The space of a search: for each setting a range of numbers, or a list of values."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from hmasd_jax.config import TrainConfig, change, to_json
from hmasd_jax.validation import ConfigError

TASKS = ("env.", "algorithm.")
"""Beginnings of the names that can be searched. Other settings say how long and how often a run is
measured, so that trials would not be comparable."""


class Range(NamedTuple):
    """Numbers from `low` to `high`, whole ones if both ends are of type int."""

    low: float
    high: float
    log: bool
    """True if ratios count instead of differences."""


class Choices(NamedTuple):
    """Values as typed on the command line."""

    texts: tuple[str, ...]


Space = dict[str, Range | Choices]
"""The values to search, by dotted name of the setting."""


def read_space(config: TrainConfig, settings: Sequence[tuple[str, Sequence[str]]]) -> Space:
    """Read what to search, and check all ends and values against the preset.

    Args:
        config: The preset.
        settings: Dotted name and values of each setting. One value LOW:HIGH or LOW:HIGH:log is a
            range.

    Raises:
        ConfigError: A setting is unknown or no part of env and algorithm, a range is not one, or
            the setting refuses a value.
    """
    if not settings:
        raise ConfigError(
            "--vary must name a setting and its range, as in "
            "algorithm.low_entropy_coef=0.01:0.1:log"
        )
    space: Space = {}
    for name, texts in settings:
        if not name.startswith(TASKS):
            raise ConfigError(f"--vary {name}: only settings of env and algorithm can be searched")
        if name.endswith(".name"):
            raise ConfigError(
                f"--vary {name}: each has settings of its own; search them one by one"
            )
        if len(texts) > 1:
            for text in texts:
                change(config, {name: text})  # raises the errors
            space[name] = Choices(tuple(texts))
        else:
            space[name] = _read_range(config, name, texts[0])
    return space


def _read_range(config: TrainConfig, name: str, text: str) -> Range:
    """Read LOW:HIGH or LOW:HIGH:log."""
    where, parts = f"--vary {name}={text}", text.split(":")
    if len(parts) not in (2, 3) or (len(parts) == 3 and parts[2] != "log"):
        raise ConfigError(f"{where}: write a range as LOW:HIGH or LOW:HIGH:log, or several values")
    low, high = (value_of(change(config, {name: part}), name) for part in parts[:2])
    if type(low) not in (int, float) or type(high) is not type(low):
        raise ConfigError(f"{where}: {name} is not a number; list its values, as in {name}=A,B")
    if not (low < high and math.isfinite(low) and math.isfinite(high)):
        raise ConfigError(f"{where}: LOW must be below HIGH")
    log = len(parts) == 3
    if log and low <= 0:
        raise ConfigError(f"{where}: a log range must begin above 0")
    return Range(low, high, log)


def value_of(config: TrainConfig, name: str) -> Any:
    """Return the resolved value of a dotted name, as JSON has it."""
    value = to_json(config)
    for part in name.split("."):
        value = value[part]
    return value


def count(space: Space) -> float:
    """Return the number of combinations, infinite with a range of fractions."""
    sizes = [
        len(part.texts)
        if isinstance(part, Choices)
        else part.high - part.low + 1
        if isinstance(part.low, int)
        else math.inf
        for part in space.values()
    ]
    return math.prod(sizes)


def preset_values(config: TrainConfig, space: Space) -> dict[str, Any] | None:
    """Return the preset's own values as the space writes them; None if one is outside of it."""
    found: dict[str, Any] = {}
    for name, part in space.items():
        own = value_of(config, name)
        if isinstance(part, Range):
            inside = [own] if type(own) is type(part.low) and part.low <= own <= part.high else []
        else:
            inside = [t for t in part.texts if value_of(change(config, {name: t}), name) == own]
        if not inside:
            return None
        found[name] = inside[0]
    return found
