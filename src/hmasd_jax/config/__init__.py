"""Configuration of a run: frozen dataclasses from files and command lines."""

from hmasd_jax.config.former_names import RENAMED, rename
from hmasd_jax.config.train_config import (
    Placement,
    TrainConfig,
    build,
    change,
    from_json,
    identity,
    load,
    name_differences,
    override,
    read_table,
    subtable,
    to_json,
)
from hmasd_jax.validation import ConfigError

__all__ = [
    "RENAMED",
    "ConfigError",
    "Placement",
    "TrainConfig",
    "build",
    "change",
    "from_json",
    "identity",
    "load",
    "name_differences",
    "override",
    "read_table",
    "rename",
    "subtable",
    "to_json",
]
