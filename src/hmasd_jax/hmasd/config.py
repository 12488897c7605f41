"""Settings of HMASD, from the paper's Table 3 and the authors' code."""

import math
from dataclasses import dataclass, field
from typing import Any, Literal

from hmasd_jax.exploration.frontier import FrontierConfig, check_frontier_counts
from hmasd_jax.exploration.greedy_copies import check_sharpening
from hmasd_jax.exploration.novelty import NoveltyConfig
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
    """Updates (rollouts) over which lambda_l falls linearly to 0. With 0 it stays constant, as in
    the paper."""
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
    solved_gain: float = 0.0
    """Weight that the rewards for skills gain once the team solves its task, in units of
    lambda_e times the mean team reward of a step and of what q_d does not know yet, so that skills
    become different ways to solve it. Needs the `frontier`, which counts the episodes that a reward
    ends. The paper has none."""
    solved_entropy_coef: float = 0.0
    """Weight that the coordinator's entropy gains once the team solves its task, so that all skills
    stay in use. Needs the `frontier`. The paper has none."""
    sharpening: float = 0.0
    """Weight against the entropy of actions, per share of episodes that sampled play loses and
    greedy play wins, once the team solves its task. Needs the `frontier` and
    `imitation.greedy_copies`. The paper has none."""
    solved_step_factor: float = 1.0
    """Factor of the coordinator's steps once a reward ends every episode. It is 1 while none does,
    and linear between. Needs the `frontier`, which counts these episodes."""
    solved_low_step_factor: float = 1.0
    """Factor of the discoverer's steps once a reward ends every episode. It falls from 1 with the
    chance that a reward ends the episodes of all copies. Needs the `frontier`, too."""
    solved_low_entropy_coef: float = 0.0
    """Weight that the entropy of actions gains once the team solves its task, times what q_d does
    not know yet: actions that hardly vary leave skills nothing to differ in. Needs the `frontier`.
    The paper has none."""
    solved_random_share: float = 0.0
    """Share of the segments in training that draw all skills at random once the team solves its
    task, so that none is forgotten. The coordinator does not learn from them. Needs the `frontier`.
    The paper has none."""
    solved_balance: float = 0.0
    """Degree to which pairs of a team skill and an individual skill weigh alike in the loss of q_d
    once the team solves its task. With 0 (the paper) q_d can learn which skills the coordinator
    prefers, instead of what they do. Needs the `frontier`."""
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
        check_range(self, "solved_gain", "solved_entropy_coef", "solved_low_entropy_coef", low=0)
        check_range(self, "sharpening", low=0)
        check_range(self, "solved_step_factor", "solved_low_step_factor", low=0, high=1)
        check_range(self, "solved_random_share", "solved_balance", low=0, high=1)
        check_frontier_counts(
            self, solved_gain=0, solved_entropy_coef=0, solved_low_entropy_coef=0,
            solved_random_share=0, solved_balance=0, sharpening=0, solved_step_factor=1,
            solved_low_step_factor=1,
        )  # fmt: skip
        check_sharpening(self.sharpening, self.imitation)
        if self.solved_gain > 0 and self.extrinsic_coef == 0:
            raise ValueError(
                f"solved_gain {self.solved_gain} needs extrinsic_coef above 0: the gain is in "
                "units of what it pays"
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
