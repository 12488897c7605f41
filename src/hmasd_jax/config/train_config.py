"""The configuration of a run, and how it is read, written and built."""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

from envs_jax import Environment
from envs_jax.alice_and_bob import AliceAndBob
from envs_jax.choices import show, suggest
from hmasd_jax.algorithms import ALGORITHMS
from hmasd_jax.config.former_names import rename
from hmasd_jax.config.from_table import Text, from_table
from hmasd_jax.config.names import find_algorithm, find_env, name_of_algorithm, name_of_env
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.types import Algorithm
from hmasd_jax.validation import (
    LARGEST,
    ConfigError,
    check_range,
    check_types,
    parse_json,
    parse_toml,
)

EnvT = TypeVar("EnvT")
AlgorithmT = TypeVar("AlgorithmT")
Placement = Literal["auto", "workers", "vmap", "map", "sharded"]
DEFAULT_NAMES = {"env": "alice_and_bob", "algorithm": "hmasd"}

EXTENSIBLE = ("total_env_steps", "num_seeds", "placement")
"""Settings of `TrainConfig` that may change when a run is resumed; no trained number depends on
them."""
ROOTS = (Path(__file__).parents[1], Path(__file__).parents[3])
"""Folders that have the presets in `configs/`: an installed package, and a checkout."""


@dataclass(frozen=True)
class TrainConfig(Generic[EnvT, AlgorithmT]):
    """Settings of one experiment; defaults are the paper's HMASD on Alice_and_Bob (Tables 1 to 3).

    Raises:
        ValueError: A number is out of range, or `total_env_steps` takes too few or many updates.
    """

    env: EnvT = field(default_factory=AliceAndBob)  # pyrefly: ignore
    """Settings of the environment."""
    algorithm: AlgorithmT = field(default_factory=HMASDConfig)  # pyrefly: ignore
    """Settings of the algorithm."""
    total_env_steps: int = 3_000_000
    """Environment steps per seed, rounded down to whole updates."""
    eval_interval: int = 80_000
    """Environment steps between evaluations. The first is at step 0, and one is at the end."""
    eval_episodes: int = 100
    """Episodes per evaluation. Skills and actions are the most probable ones (arg-max)."""
    log_interval: int = 16_000
    """Environment steps over which each line of training metrics is pooled."""
    checkpoint_interval: int = 80_000
    """Environment steps between checkpoints. One is saved at the end, too."""
    keep_checkpoints: int = 3
    """Number of newest checkpoints kept on disk, per seed."""
    seed: int = 0
    """Seed of the experiment. Training run i of a sweep uses `fold_in(key(seed), i)`."""
    num_seeds: int = 5
    """Number of training runs of a sweep; `train` runs one of them."""
    placement: Placement = "auto"
    """Placement of a sweep's seeds on the hardware: `workers`, one single-threaded process per
    core; `vmap`, all at once in one program; `map`, one after the other in one program; `sharded`,
    over all devices. `auto` chooses `workers` on a CPU, `vmap` on one accelerator and `sharded` on
    several. The placement does not change the files of a run."""

    def __post_init__(self) -> None:
        check_types(self)
        intervals = ("eval_interval", "log_interval", "checkpoint_interval")
        check_range(self, "total_env_steps", *intervals, low=1, high=2**62)
        check_range(self, "eval_episodes", low=1, high=1_000_000)
        check_range(self, "num_seeds", low=1, high=100_000)
        check_range(self, "keep_checkpoints", low=1)
        check_range(self, "seed", low=0, high=2**32 - 1)
        per_update = self.env_steps_per_update
        if self.total_env_steps < per_update:
            part = f"algorithm.{_rollout_part(self.algorithm)}"
            raise ValueError(
                f"total_env_steps {self.total_env_steps} is less than one update takes "
                f"({per_update} = {part}.num_envs x {part}.rollout_length): "
                "raise it or lower those"
            )
        if self.total_env_steps // per_update > LARGEST:
            raise ValueError(
                f"total_env_steps {self.total_env_steps} takes "
                f"{self.total_env_steps // per_update} updates: lower it to at most "
                f"{LARGEST * per_update}"
            )

    @property
    def env_steps_per_update(self) -> int:
        """Environment steps per update: one rollout of all environment copies."""
        part = getattr(self.algorithm, _rollout_part(self.algorithm))
        return part.num_envs * part.rollout_length


def _rollout_part(algorithm: Any) -> str:
    """Return the name of the settings that say how long a rollout is, e.g. `ppo`."""
    for field_ in dataclasses.fields(algorithm):
        if hasattr(getattr(algorithm, field_.name), "rollout_length"):
            return field_.name
    raise ValueError(
        f"algorithm must have a field with num_envs and rollout_length, and "
        f"{type(algorithm).__name__} has none: add one, e.g. `ppo: PPOConfig`"
    )


def load(path: Path | str | None = None, overrides: Mapping[str, Any] | None = None) -> TrainConfig:
    """Read a configuration.

    Args:
        path: A .toml file, a run's config.json, or None for the defaults. `configs/TASK/NAME.toml`
            is a preset of the library wherever the current folder has no such file.
        overrides: Values by dotted name, e.g. `{"algorithm.ppo.num_envs": 8}`. They win over the
            file. An `env.name` or `algorithm.name` that differs from the file's discards that
            table of the file.

    Raises:
        ConfigError: The file cannot be read, a key or name is unknown, or a value has the wrong
            type or is out of range.
    """
    table = read_table(_find_file(Path(path))) if path is not None else {}
    return from_json(override(table, overrides or {}))


def _find_file(path: Path) -> Path:
    """Return a path, or that of the preset of the library which it names."""
    if path.exists() or path.parts[:1] != ("configs",):
        return path
    presets = (root / path for root in ROOTS)
    return next((preset for preset in presets if preset.exists()), path)


def override(table: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested tables with values by dotted name put into them.

    A new `env.name` or `algorithm.name` clears that table first, because its settings belong to
    another class.

    Args:
        table: Nested tables as in a file. The inner ones are changed in place.
        overrides: Values by dotted name.

    Raises:
        ConfigError: A dotted name passes through a value that is not a table, or a setting is given
            by its former name and by the new one.
    """
    table, overrides = rename(table), rename(overrides)
    for section in ("env", "algorithm"):
        name = overrides.get(f"{section}.name")
        if name is not None and str(name) != subtable(table, section).get(
            "name", DEFAULT_NAMES[section]
        ):
            table[section] = {}
    for dotted, value in overrides.items():
        *parents, last = dotted.split(".")
        node = table
        for parent in parents:
            node = node.setdefault(parent, {})
            if not isinstance(node, dict):
                raise ConfigError(f"unknown key {dotted}: {parent} is not a table")
        node[last] = value
    return table


def from_json(table: Mapping[str, Any]) -> TrainConfig:
    """Build the configuration that nested plain values describe; the inverse of `to_json`.

    Raises:
        ConfigError: A key or name is unknown, or a value has the wrong type or is out of range.
    """
    table = rename(table)
    env, algorithm = subtable(table, "env"), subtable(table, "algorithm")
    env_type = find_env(env.pop("name", DEFAULT_NAMES["env"]))
    entry = find_algorithm(algorithm.pop("name", DEFAULT_NAMES["algorithm"]))
    built = {
        "env": from_table(env_type, env, "env"),
        "algorithm": from_table(entry.config, algorithm, "algorithm"),
    }
    return from_table(TrainConfig, {**table, **built})


def change(config: TrainConfig, values: Mapping[str, Any]) -> TrainConfig:
    """Return a configuration with other values by dotted name; texts are read as typed.

    Raises:
        ConfigError: A setting is unknown or refuses its value.
    """
    typed = {n: Text(v) if isinstance(v, str) else v for n, v in values.items()}
    return from_json(override(to_json(config), typed))


def to_json(config: TrainConfig) -> dict[str, Any]:
    """Return a configuration as nested JSON values, with names of environment and algorithm.

    Raises:
        ConfigError: A class is not registered, or a value has a type that JSON lacks.
    """
    table = dataclasses.asdict(config)
    env, algorithm = type(config.env), type(config.algorithm)
    table["env"] = {"name": name_of_env(env), **table["env"]}
    table["algorithm"] = {"name": name_of_algorithm(algorithm), **table["algorithm"]}
    for name, value in _flatten(table).items():
        try:
            json.dumps(value, default=_write_path)
        except TypeError as error:
            raise ConfigError(f"{name} cannot be written to config.json: {error}") from error
    return json.loads(json.dumps(table, default=_write_path))  # Tuples become lists, as on disk.


def _write_path(value: Any) -> str:
    """Return a path as JSON has it. Values of other types have no form there."""
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{show(value)} is neither a number, text, list nor path")


def identity(table: dict[str, Any]) -> dict[str, Any]:
    """Return by dotted name the settings that resuming must not change: all but `EXTENSIBLE`."""
    flat = _flatten(rename(table))
    return {name: value for name, value in flat.items() if name not in EXTENSIBLE}


def name_differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Return a text that names the differences, in the order of `old`; empty if there are none."""
    names = [name for name in dict.fromkeys((*old, *new)) if old.get(name) != new.get(name)]
    return ", ".join(f"{name} (was {old.get(name)}, now {new.get(name)})" for name in names)


def _flatten(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in table.items():
        if isinstance(value, dict) and value:
            flat |= _flatten(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value
    return flat


def build(config: TrainConfig) -> tuple[Environment, Algorithm]:
    """Build the environment and the algorithm that `config` describes.

    Raises:
        ConfigError: The algorithm's settings are of an unregistered class, or do not fit the
            environment.
    """
    entry = ALGORITHMS[name_of_algorithm(type(config.algorithm))]
    return config.env, entry.make(config.env, config.algorithm)


def read_table(path: Path) -> dict[str, Any]:
    """Read a .toml or .json file whose outermost value is a table.

    Raises:
        ConfigError: The file cannot be read or is not valid; the message names it.
    """
    parse = parse_json if path.suffix == ".json" else parse_toml
    try:
        table = parse(path.read_bytes())
    except FileNotFoundError as error:
        endings = (".toml", ".json")
        others = sorted(x.name for x in path.parent.glob("*") if x.suffix in endings)
        hint = suggest(path.name, others) if others else ""
        raise ConfigError(f"cannot read config file {path}: {error.strerror}{hint}") from error
    except OSError as error:
        raise ConfigError(f"cannot read config file {path}: {error.strerror}") from error
    except ValueError as error:  # Both parsers give line and column.
        kind = "JSON" if path.suffix == ".json" else "TOML"
        raise ConfigError(f"{path} is not valid {kind}: {error}") from error
    if not isinstance(table, dict):
        raise ConfigError(f"{path} is damaged: it must hold a table of settings, got {show(table)}")
    return table


def subtable(table: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return a copy of the table `name`."""
    section = table.get(name, {})
    if not isinstance(section, Mapping):
        raise ConfigError(
            f'{name} must be a table with a name, e.g. [{name}] name = "...", got {show(section)}'
        )
    return dict(section)
