"""MAPPO (Yu et al., NeurIPS 2022), and the pieces that IPPO and EITI share with it."""

from hmasd_jax.baselines.mappo.algorithm import MAPPOState, make_mappo
from hmasd_jax.baselines.mappo.components import MAPPOConfig

__all__ = ["MAPPOConfig", "MAPPOState", "make_mappo"]
