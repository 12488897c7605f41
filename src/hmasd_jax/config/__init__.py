"""Configuration of a run: files and command lines into frozen dataclasses."""

from hmasd_jax.config.train_config import (
    Layout,
    TrainConfig,
    build,
    from_json,
    identity,
    load,
    override,
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
    "to_json",
]
