"""Settings of the baselines MAPPO and MAT."""

from dataclasses import dataclass, field
from typing import Literal

from hmasd_jax.ppo import PPOConfig
from hmasd_jax.settings import check_divides, check_range


@dataclass(frozen=True)
class MAPPOConfig:
    """MAPPO on one task; the defaults are the paper's, on-policy's `rmappo`."""

    entropy_coef: float = 0.01
    """Weight of the policy's entropy."""
    recurrent: bool = True
    """Whether actor and critic have a memory (on-policy's `rmappo`) or not (its `mappo`)."""
    critic_input: Literal["state", "agent"] = "state"
    """What the critic sees: the global `state`, once for all agents, or, for a value per `agent`,
    the state, the agent's observation and its index."""
    death_masking: bool = True
    """With `critic_input` "agent": whether the critic sees nothing but the index of an agent that
    has no choice of actions, as the dead."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Optimization settings."""

    def __post_init__(self) -> None:
        check_range(self, "entropy_coef", low=0)


@dataclass(frozen=True)
class MATConfig:
    """MAT on one task; the defaults are the paper's."""

    entropy_coef: float = 0.01
    """Weight of the policy's entropy."""
    num_blocks: int = 1
    """Encoder blocks and decoder blocks."""
    num_heads: int = 1
    """Attention heads."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Optimization settings. MAT has no memory: `sequence_length` means nothing to it."""

    def __post_init__(self) -> None:
        check_range(self, "entropy_coef", low=0)
        check_range(self, "num_blocks", "num_heads", low=1)
        check_divides("num_heads", self.num_heads, "ppo.hidden_size", self.ppo.hidden_size)
