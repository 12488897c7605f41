"""Configuration of a run: frozen dataclasses from files and command lines."""

from hmasd_jax.config.train_config import (
    Layout,
    TrainConfig,
    build,
    from_json,
    identity,
    load,
    override,
    read_table,
    subtable,
    to_json,
)
from hmasd_jax.validation import ConfigError

__all__ = [
    "ConfigError",
    "Layout",
    "TrainConfig",
    "build",
    "from_json",
    "identity",
    "load",
    "override",
    "read_table",
    "subtable",
    "to_json",
]
