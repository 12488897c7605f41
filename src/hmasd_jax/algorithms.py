"""Algorithms by name."""

from collections.abc import Callable
from typing import Any, NamedTuple

from envs_jax import Environment
from hmasd_jax.baselines.eiti.algorithm import make_edti, make_eiti
from hmasd_jax.baselines.eiti.config import EDTIConfig, EITIConfig
from hmasd_jax.baselines.ippo import IPPOConfig, make_ippo
from hmasd_jax.baselines.mappo import MAPPOConfig, make_mappo
from hmasd_jax.baselines.mat import MATConfig, make_mat
from hmasd_jax.baselines.qmix.algorithm import make_maser, make_qmix, make_vdn
from hmasd_jax.baselines.qmix.config import MASERConfig, QMIXConfig, VDNConfig
from hmasd_jax.hmasd.algorithm import make_hmasd
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.types import Algorithm


class AlgorithmEntry(NamedTuple):
    """Entry of the registry that configuration files and command lines use."""

    config: type
    """Class of its settings: a frozen dataclass that no other entry has, since it names the
    algorithm. One of its fields has `num_envs` and `rollout_length`, e.g. `ppo`."""
    make: Callable[[Environment, Any], Algorithm]
    """`make(env, config)`."""


ALGORITHMS: dict[str, AlgorithmEntry] = {
    "edti": AlgorithmEntry(EDTIConfig, make_edti),
    "eiti": AlgorithmEntry(EITIConfig, make_eiti),
    "hmasd": AlgorithmEntry(HMASDConfig, make_hmasd),
    "ippo": AlgorithmEntry(IPPOConfig, make_ippo),
    "mappo": AlgorithmEntry(MAPPOConfig, make_mappo),
    "mat": AlgorithmEntry(MATConfig, make_mat),
    "maser": AlgorithmEntry(MASERConfig, make_maser),
    "qmix": AlgorithmEntry(QMIXConfig, make_qmix),
    "vdn": AlgorithmEntry(VDNConfig, make_vdn),
}
