"""Settings of VDN, QMIX and MASER."""

from dataclasses import dataclass, field
from typing import Literal

from hmasd_jax.validation import SMALLEST, check_range, check_types

MASERVariant = Literal["released", "paper"]


@dataclass(frozen=True)
class QLearningConfig:
    """Settings shared by all algorithms that learn from replayed episodes.

    The defaults are PyMARL's, except that several copies of the environment step at once.
    """

    num_envs: int = 8
    """E, environment copies per seed. PyMARL has one."""
    rollout_length: int = 100
    """Environment steps per copy between two updates. Episodes continue from one update to the
    next."""
    gradient_steps: int = 8
    """Gradient steps per update. PyMARL takes one per episode."""
    batch_size: int = 32
    """B, episodes per gradient step. Learning starts once so many have ended."""
    buffer_size: int = 5000
    """Number of newest episodes to learn from."""
    learning_rate: float = 5e-4
    """Step size of RMSprop."""
    rms_decay: float = 0.99
    """Decay of RMSprop's average of squared gradients."""
    rms_epsilon: float = 1e-5
    """Constant added to the denominator of RMSprop."""
    max_grad_norm: float = 10.0
    """Largest norm of the whole gradient. A larger gradient is scaled down to it."""
    discount: float = 0.99
    """gamma, per environment step."""
    bootstrap_truncation: bool = False
    """If True, an episode cut by its time limit is bootstrapped from its last state. The authors'
    environment treats time limits as terminal."""
    epsilon_start: float = 1.0
    """Probability of a random action in the first rollout."""
    epsilon_end: float = 0.05
    """Probability of a random action after `epsilon_steps`."""
    epsilon_steps: int = 50_000
    """Environment steps over which that probability falls linearly."""
    target_interval: int = 200
    """Gradient steps between two copies of the networks to the target networks."""
    hidden_size: int = 64
    """Width of the agents' network and of its memory."""

    def __post_init__(self) -> None:
        check_types(self)
        check_range(self, "num_envs", "rollout_length", "gradient_steps", "batch_size", low=1)
        check_range(self, "buffer_size", "target_interval", low=1)
        check_range(self, "hidden_size", low=1, high=2**16)
        check_range(self, "learning_rate", "epsilon_steps", low=0)
        check_range(self, "rms_epsilon", "max_grad_norm", low=SMALLEST)
        check_range(self, "rms_decay", "discount", "epsilon_start", "epsilon_end", low=0, high=1)
        if self.buffer_size < self.batch_size:
            raise ValueError(
                f"buffer_size {self.buffer_size} is smaller than batch_size {self.batch_size}, so "
                "that no batch can be drawn: raise it or lower batch_size"
            )


@dataclass(frozen=True)
class VDNConfig:
    """Settings of VDN."""

    q_learning: QLearningConfig = field(default_factory=QLearningConfig)
    """Settings of replay and optimization."""

    def __post_init__(self) -> None:
        check_types(self)


@dataclass(frozen=True)
class QMIXConfig:
    """Settings of QMIX."""

    mixing_size: int = 32
    """Width of the mixing network."""
    q_learning: QLearningConfig = field(default_factory=QLearningConfig)
    """Settings of replay and optimization."""

    def __post_init__(self) -> None:
        check_types(self)
        check_range(self, "mixing_size", low=1)


@dataclass(frozen=True)
class MASERConfig(QMIXConfig):
    """Settings of MASER. The defaults are those of the authors' configuration file."""

    intrinsic_coef: float = 0.03
    """lambda: weight of the distance to the subgoal, beside the team reward."""
    individual_weight: float = 0.5
    """alpha: weight of an agent's own value in the choice of its subgoal, against the total's."""
    individual_coef: float = 8e-4
    """Weight of the agents' own temporal-difference loss."""
    exploration_coef: float = 6e-5
    """Weight of the loss that makes the values of all actions equal from the subgoal on. Only for
    `variant` "paper"."""
    distance_coef: float = 1.4e-4
    """Weight of the loss that trains the distance. Only for `variant` "paper"."""
    variant: MASERVariant = "released"
    """`released` follows the authors' code, whose optimizer leaves out the network that measures
    distance: it stays as it was initialized. `paper` trains it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        coefs = ("intrinsic_coef", "individual_coef", "exploration_coef", "distance_coef")
        check_range(self, *coefs, low=0)
        check_range(self, "individual_weight", low=0, high=1)
