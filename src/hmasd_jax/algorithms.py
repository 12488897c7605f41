"""Algorithms by name."""

from collections.abc import Callable
from typing import Any, NamedTuple

from envs_jax import Environment
from hmasd_jax.baselines import MAPPOConfig, MATConfig
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.types import Algorithm


class AlgorithmEntry(NamedTuple):
    """What the command line needs to know of an algorithm."""

    config: type
    """Its settings, a frozen dataclass with a field `ppo`."""
    make: Callable[[Environment, Any], Algorithm]
    """`make(env, config)`."""


# Imported late: `--help` and configuration errors need none of the networks.


def _make_hmasd(env: Environment, config: HMASDConfig) -> Algorithm:
    from hmasd_jax.hmasd.algorithm import make_hmasd

    return make_hmasd(env, config)


def _make_mappo(env: Environment, config: MAPPOConfig) -> Algorithm:
    from hmasd_jax.mappo import make_mappo

    return make_mappo(env, config)


def _make_mat(env: Environment, config: MATConfig) -> Algorithm:
    from hmasd_jax.mat import make_mat

    return make_mat(env, config)


ALGORITHMS: dict[str, AlgorithmEntry] = {
    "hmasd": AlgorithmEntry(HMASDConfig, _make_hmasd),
    "mappo": AlgorithmEntry(MAPPOConfig, _make_mappo),
    "mat": AlgorithmEntry(MATConfig, _make_mat),
}
