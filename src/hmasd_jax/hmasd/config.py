"""Settings of HMASD, from the paper's Table 3 and the authors' code."""

import math
from dataclasses import dataclass, field
from typing import Any, Literal

from hmasd_jax.exploration.frontier_config import FrontierConfig
from hmasd_jax.exploration.novelty import NoveltyConfig
from hmasd_jax.exploration.solved import SolvedConfig, check_solved
from hmasd_jax.exploration.successes import ImitationConfig
from hmasd_jax.hmasd.distance import DistanceConfig
from hmasd_jax.networks.recurrent import SkillAt
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.validation import (
    check_divides,
    check_indices,
    check_multiple,
    check_range,
    check_types,
)

CoordinatorKind = Literal["learned", "team_only", "random"]


@dataclass(frozen=True)
class SolvedSkillsConfig(SolvedConfig):
    """Settings of what changes once the task is solved, in HMASD. The paper changes nothing.

    p is the chance that the episodes of all copies of the environment are solved.
    """

    coordinator_step_factor: float = 1.0
    """Factor of the coordinator's learning rate, which falls from 1 as the share of solved episodes
    rises."""
    skill_gain: float = 0.0
    """Weight that the rewards for skills gain, in units of p lambda_e times the mean team reward of
    a step and of what q_d does not know yet, so that skills become different ways to solve the
    task."""
    high_entropy_coef: float = 0.0
    """Weight that the coordinator's entropy gains, in units of p, so that all skills stay in
    use."""
    low_entropy_coef: float = 0.0
    """Weight that the entropy of actions gains, in units of p and of what q_d does not know yet:
    actions that hardly vary leave skills nothing to differ in."""
    random_share: float = 0.0
    """Share of segments in training, in units of p, that draw all skills at random, so that none is
    forgotten. The coordinator does not learn from them."""
    balance: float = 0.0
    """Degree, in units of p, to which pairs of a team skill and an individual skill weigh alike in
    the loss of q_d. With 0 q_d can learn which skills the coordinator prefers, instead of what they
    do."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "skill_gain", "high_entropy_coef", "low_entropy_coef", low=0)
        check_range(self, "coordinator_step_factor", "random_share", "balance", low=0, high=1)


@dataclass(frozen=True)
class HMASDConfig:
    """Settings of HMASD. The defaults are the paper's for Alice_and_Bob."""

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
    """Updates (rollouts) over which lambda_l, with all that is added to it, falls linearly to 0.
    With 0 it stays constant, as in the paper."""
    low_advantage_floor: float = 0.0
    """Smallest deviation that the low level's advantages are divided by, in units of Eq. 4's r^i.
    With 0 (the paper) they are divided by their own deviation. While skills cannot be told apart
    and no reward comes, the low level then learns noise at full strength."""
    extrinsic_coef: float = 0.0
    """lambda_e, weight of the team reward in Eq. 4."""
    team_intrinsic_coef: float = 0.1
    """lambda_D, weight of log q_D in Eq. 4."""
    individual_intrinsic_coef: float = 0.2
    """lambda_d, weight of log q_d in Eq. 4."""
    skill_at: SkillAt = "last_layer"
    """Layer at which skills enter actor and critic: beside the raw input, or at the last layer,
    where a skill is an offset on the action logits. The authors use `last_layer` for Alice_and_Bob
    and Overcooked, `input` for SMAC."""
    discriminator_epochs: int = 15
    """Gradient steps on the discriminators per rollout, each on the whole rollout."""
    discriminator_obs: tuple[int, ...] = ()
    """Indices of the features of obs that q_d sees, such as the agent's position. Without any, as
    in the paper, it sees all of them."""
    discriminator_center: bool = False
    """If True, the inputs of the discriminators are shifted to a mean of 0 over the rollout and
    divided by one deviation for all features. Without it (the paper), their input LayerNorm hides
    places where all features are small, such as a corner at (1, 1) in raw coordinates."""
    discriminator_noise: float = 0.0
    """Largest standard deviation of Gaussian noise on the inputs of the discriminators. Each sample
    draws its own uniformly from 0 to it, in the units of obs and state, or, with
    `discriminator_center`, in those of their deviation. Without noise (the paper), skills that can
    barely be told apart pay as much as skills that lead far apart."""
    coordinator: CoordinatorKind = "learned"
    """Kind of coordinator: the `learned` one; one that learns only the team skill, which every
    agent then uses as its own (`team_only`, the ablation NoIndi); or chance (`random`; NoHigh also
    keeps skills for a whole episode, with `segment_clock` and `skill_interval`)."""
    num_blocks: int = 1
    """Encoder blocks and decoder blocks of the coordinator."""
    num_heads: int = 1
    """Attention heads of the coordinator."""
    discriminate: Literal["next", "outcome"] = "next"
    """Definition of s_{t+1}, o_{t+1} at the end of an episode, for the discriminators: `next`, the
    first of the new episode (the authors' code), or `outcome`, the true last one."""
    segment_clock: Literal["rollout", "episode"] = "rollout"
    """Clock that renews skills in training: every k steps of the `rollout`, for all copies at once
    and across episode ends (the authors' code), or at steps 0, k, 2k and so on of each `episode`,
    like evaluation and Algorithm 1."""
    zero_reward_guard: bool = False
    """If True, drop the coordinator's policy term when all its rewards in a rollout are equal,
    since normalized advantages are then amplified noise."""
    skill_prior: bool = False
    """If True, subtract log p of a uniform prior from the intrinsic rewards, like Eq. 1 and unlike
    Eqs. 3-4. Without it each step costs up to lambda_D ln n_Z + lambda_d ln n_z."""
    solved: SolvedSkillsConfig = field(default_factory=SolvedSkillsConfig)
    """Changes once the task is solved. p is the chance that the episodes of all copies of
    the environment are solved. Needs the `frontier`. The paper has none."""
    distance: DistanceConfig = field(default_factory=DistanceConfig)
    """Reward for skills that lead far apart. The paper has none."""
    novelty: NoveltyConfig = field(default_factory=NoveltyConfig)
    """Bonus for states not seen before. The paper has none."""
    frontier: FrontierConfig = field(default_factory=FrontierConfig)
    """Bonus for values of single features that few episodes reach. The paper has none."""
    imitation: ImitationConfig = field(default_factory=ImitationConfig)
    """Imitation of own successes. The paper has none."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Optimization settings of both levels."""

    def __post_init__(self) -> None:
        check_types(self)
        ppo = self.ppo
        ppo.check_sequences()
        check_range(self, "skill_interval", low=1)
        check_range(self, "num_team_skills", "num_skills", low=1, high=1024)
        check_range(self, "low_entropy_decay_updates", low=0)
        check_range(self, "discriminator_epochs", "num_heads", low=1)
        check_range(self, "num_blocks", low=1, high=100)
        check_range(self, "high_entropy_coef", "low_entropy_coef", "extrinsic_coef", low=0)
        check_range(self, "team_intrinsic_coef", "individual_intrinsic_coef", low=0)
        check_range(self, "discriminator_noise", "low_advantage_floor", low=0)
        check_solved(self)
        if self.solved.skill_gain > 0 and self.extrinsic_coef == 0:
            raise ValueError(
                f"solved.skill_gain {self.solved.skill_gain} needs extrinsic_coef above 0: the "
                "gain is in units of what it pays"
            )
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
        elif self.coordinator != "random" and self.skill_interval > ppo.rollout_length:
            raise ValueError(
                f"skill_interval must be at most ppo.rollout_length = {ppo.rollout_length} with a "
                f"coordinator that learns, got {self.skill_interval}: a rollout may else hold no "
                "choice of skills to learn from"
            )
        self.imitation.check_copies(ppo.num_envs)
        check_divides("num_heads", self.num_heads, "ppo.hidden_size", ppo.hidden_size)
        # The coordinator's samples are segments, fewer than the sequences of the low level.
        check_divides(
            "ppo.num_minibatches", ppo.num_minibatches, "the coordinator's batch", self.num_segments
        )

    @property
    def num_segments(self) -> int:
        """Number of segments per rollout that train the coordinator, repeated if there are fewer.

        The clock of the rollout makes exactly as many. With that of the episode their number
        varies: episodes that end early make more.
        """
        segments = self.ppo.num_envs * math.ceil(self.ppo.rollout_length / self.skill_interval)
        return segments if self.segment_clock == "rollout" else 2 * segments


def count_skills(config: Any) -> tuple[int, int]:
    """Return n_Z and n_z of an algorithm's settings, or zeros if it lacks either kind of skill."""
    counts = getattr(config, "num_team_skills", 0), getattr(config, "num_skills", 0)
    return counts if all(counts) else (0, 0)
