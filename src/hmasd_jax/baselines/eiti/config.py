"""Settings of EITI and EDTI."""

from dataclasses import dataclass, field

from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.validation import check_indices, check_range, check_types


@dataclass(frozen=True)
class LocalStateConfig:
    """Settings of the local states, which transitions and visits are counted by."""

    features: tuple[int, ...] = ()
    """Indices of the features of an agent's observation that make up its local state. Without any,
    all do. The fewer values they have together, the more the counts say."""
    resolution: float = 0.01
    """Features are rounded to multiples of this."""
    table_size: int = 2**22
    """Slots in each of the two rows of the table that holds all counts, 4 bytes each."""

    def __post_init__(self) -> None:
        check_types(self)
        check_indices(self, "features")
        check_range(self, "resolution", low=1e-6)
        check_range(self, "table_size", low=2, high=2**28)


@dataclass(frozen=True)
class InfluenceConfig:
    """Settings that EITI and EDTI share.

    Default weights are those of the authors' command for their task Pass, for rewards of 1 instead
    of 1000: a thousandth of them, where they have the unit of a reward.
    """

    entropy_coef: float = 0.01
    """Weight of the policy's entropy."""
    recurrent: bool = True
    """If True, actors and critics have a memory. Those of the authors have none."""
    curiosity_coef: float = 0.01
    """eta: weight of 1 / sqrt(visits + 1) of the local state that an agent reaches."""
    local_state: LocalStateConfig = field(default_factory=LocalStateConfig)
    """Settings of the counts."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Optimization settings."""

    def __post_init__(self) -> None:
        check_types(self)
        check_range(self, "entropy_coef", "curiosity_coef", low=0)
        self.ppo.check_sequences()


@dataclass(frozen=True)
class EITIConfig(InfluenceConfig):
    """Settings of EITI."""

    influence_coef: float = 0.001
    """beta_T: weight of an agent's influence on the transitions of the others. The authors' command
    names none; the default is 1 for their rewards of 1000."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "influence_coef", low=0)


@dataclass(frozen=True)
class EDTIConfig(InfluenceConfig):
    """Settings of EDTI. The defaults are those of the authors' command for the task Pass."""

    others_reward_coef: float = 0.1
    """Weight of the others' team reward."""
    others_curiosity_coef: float = 0.1
    """Weight of the others' curiosity bonus, which contains eta."""
    reward_value_coef: float = 0.1
    """beta_ext: weight of influence times the value of what it leads to, in team reward."""
    curiosity_value_coef: float = 1.0
    """beta_int: weight of influence times the value of what it leads to, in curiosity bonus."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "others_reward_coef", "others_curiosity_coef", low=0)
        check_range(self, "reward_value_coef", "curiosity_value_coef", low=0)
