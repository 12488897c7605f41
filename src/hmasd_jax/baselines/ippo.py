"""IPPO, independent PPO (de Witt et al., 2020): MAPPO whose critic sees one agent's observation.

Nothing sees more than one agent does, in training as in execution. All agents share the weights of
actor and critic, like in the comparisons of Yu et al. (NeurIPS 2022).
"""

from dataclasses import dataclass
from typing import Literal

from hmasd_jax.baselines.mappo import MAPPOConfig, make_mappo


@dataclass(frozen=True)
class IPPOConfig(MAPPOConfig):
    """Settings of IPPO: those of MAPPO with the input of the critic fixed."""

    critic_input: Literal["obs"] = "obs"
    """Input of the critic: each agent's own observation."""


make_ippo = make_mappo
"""Build IPPO for an environment and an `IPPOConfig`."""
