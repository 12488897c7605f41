"""Settings of HMASD (paper Table 3, and what only the authors' code tells)."""

import math
from dataclasses import dataclass, field
from typing import Literal

from hmasd_jax.networks.recurrent import ConditionAt
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.validation import check_divides, check_indices, check_multiple, check_range

CoordinatorKind = Literal["learned", "team_only", "random"]


@dataclass(frozen=True)
class HMASDConfig:
    """HMASD on one task; the defaults are the paper's Alice_and_Bob."""

    skill_interval: int = 50
    """k, environment steps between two skill assignments."""
    num_team_skills: int = 2
    """n_Z, number of team skills."""
    num_skills: int = 4
    """n_z, number of individual skills."""
    high_entropy_coef: float = 0.1
    """lambda_h, weight of the coordinator's entropy in Eq. 6."""
    low_entropy_coef: float = 0.01
    """lambda_l, weight of the discoverer's entropy in Eq. 7."""
    low_entropy_decay_updates: int = 0
    """Updates (rollouts) over which lambda_l falls linearly to 0; 0 keeps it constant, as the paper
    does."""
    low_advantage_floor: float = 0.0
    """Least deviation that the low level's advantages are divided by, in units of Eq. 4's r^i.
    Without it (the paper) they are divided by their own, however small: as long as skills cannot be
    told apart and no reward comes, the low level learns noise at full strength."""
    extrinsic_coef: float = 0.0
    """lambda_e, weight of the team reward in Eq. 4."""
    team_intrinsic_coef: float = 0.1
    """lambda_D, weight of log q_D in Eq. 4."""
    individual_intrinsic_coef: float = 0.2
    """lambda_d, weight of log q_d in Eq. 4."""
    skill_at: ConditionAt = "last_layer"
    """Where skills enter actor and critic: beside the raw input, or at the last layer, where a
    skill is an offset on the action logits. The authors use `last_layer` for Alice_and_Bob and
    Overcooked, `input` for SMAC."""
    discriminator_epochs: int = 15
    """Gradient steps on the discriminators per rollout, each on all of it."""
    discriminator_obs: tuple[int, ...] = ()
    """Indices of the features of obs that q_d sees, such as the agent's position; none given, as in
    the paper, it sees all of them."""
    discriminator_center: bool = False
    """Whether the discriminators see obs and state with each feature's mean over the rollout at 0,
    and all features divided by one deviation. Without it (the paper), their input LayerNorm drowns
    places where all features are small, such as a corner at (1, 1) in raw coordinates."""
    discriminator_noise: float = 0.0
    """Largest standard deviation of Gaussian noise on what the discriminators see; that of each
    sample is drawn uniformly from 0 to it. In the units of obs and state, or with
    `discriminator_center` in those of their deviation. Without it (the paper), skills that can
    just be told apart pay as much as skills that lead far apart."""
    coordinator: CoordinatorKind = "learned"
    """Who assigns skills: the `learned` coordinator; one that learns the team's skill only, which
    is each agent's own as well (`team_only`, the ablation NoIndi); or chance (`random`, NoHigh)."""
    num_blocks: int = 1
    """Encoder blocks and decoder blocks of the coordinator."""
    num_heads: int = 1
    """Attention heads of the coordinator."""
    discriminate: Literal["next", "outcome"] = "next"
    """Which s_{t+1}, o_{t+1} the discriminators see at the end of an episode: `next`, what the
    next step starts from, thus the new episode's first (the authors' code), or `outcome`, the
    true last one."""
    segment_clock: Literal["rollout", "episode"] = "rollout"
    """When skills are renewed in training: every k steps of the `rollout`, for all copies at once
    and across episode ends (the authors' code), or at steps 0, k, 2k, .. of each `episode`, as in
    evaluation and as Algorithm 1 is written."""
    zero_reward_guard: bool = False
    """Whether to drop the coordinator's policy term when all its rewards in a rollout are equal
    (normalized advantages are then nothing but amplified noise)."""
    skill_prior: bool = False
    """Whether to subtract log p of a uniform prior from the intrinsic rewards, as Eq. 1 does and
    Eqs. 3-4 do not. Without it each step costs up to lambda_D ln n_Z + lambda_d ln n_z."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Optimization settings of both levels."""

    def __post_init__(self) -> None:
        ppo = self.ppo
        check_range(self, "skill_interval", "num_team_skills", "num_skills", low=1)
        check_range(self, "low_entropy_decay_updates", low=0)
        check_range(self, "discriminator_epochs", "num_blocks", "num_heads", low=1)
        check_range(self, "high_entropy_coef", "low_entropy_coef", "extrinsic_coef", low=0)
        check_range(self, "team_intrinsic_coef", "individual_intrinsic_coef", low=0)
        check_range(self, "discriminator_noise", "low_advantage_floor", low=0)
        check_indices(self, "discriminator_obs")
        if self.coordinator == "team_only" and self.num_skills != self.num_team_skills:
            raise ValueError(
                f"num_skills {self.num_skills} must be num_team_skills = {self.num_team_skills} "
                "with coordinator team_only: every agent has the team's skill"
            )
        if self.segment_clock == "rollout":
            check_multiple(
                "ppo.rollout_length", ppo.rollout_length, "skill_interval", self.skill_interval
            )
        check_divides("num_heads", self.num_heads, "ppo.hidden_size", ppo.hidden_size)
        # The coordinator's samples are segments, fewer than the sequences of the low level.
        check_divides(
            "ppo.num_minibatches", ppo.num_minibatches, "the coordinator's batch", self.num_segments
        )

    @property
    def num_segments(self) -> int:
        """Segments of a rollout that the coordinator is trained on, repeated if there are fewer.

        With the rollout's clock there are exactly as many. With the episode's clock their number
        varies: episodes that end early make more.
        """
        segments = self.ppo.num_envs * math.ceil(self.ppo.rollout_length / self.skill_interval)
        return segments if self.segment_clock == "rollout" else 2 * segments
