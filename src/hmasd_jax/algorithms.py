"""Algorithms by name."""

from collections.abc import Callable
from typing import Any, NamedTuple

from envs_jax import Environment
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.types import Algorithm


class AlgorithmEntry(NamedTuple):
    """What the command line needs to know of an algorithm."""

    config: type
    """Its settings, a frozen dataclass with a field `ppo`."""
    make: Callable[[Environment, Any], Algorithm]
    """`make(env, config)`."""


def _make_hmasd(env: Environment, config: HMASDConfig) -> Algorithm:
    # Imported late: `--help` and configuration errors need none of the networks.
    from hmasd_jax.hmasd.algorithm import make_hmasd

    return make_hmasd(env, config)


ALGORITHMS: dict[str, AlgorithmEntry] = {
    "hmasd": AlgorithmEntry(HMASDConfig, _make_hmasd),
}
