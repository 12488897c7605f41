"""The PPO objective, Eq. 5, and its settings (Table 1)."""

from dataclasses import dataclass

import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

from hmasd_jax.types import Metrics
from hmasd_jax.validation import (
    LARGEST,
    SMALLEST,
    check_divides,
    check_multiple,
    check_range,
    check_types,
)


@dataclass(frozen=True)
class PPOConfig:
    """Settings shared by all on-policy algorithms (paper Tables 1 and 2)."""

    num_envs: int = 32
    """E, environment copies per seed ("rollout threads")."""
    rollout_length: int = 100
    """T, environment steps per copy between two updates ("episode length" of Table 2)."""
    learning_rate: float = 5e-4
    """Step size of Adam for every network."""
    decay_updates: int = 0
    """Updates (rollouts) over which the step size falls linearly to 0. With 0 it stays constant, as
    in the paper. The steps of imitation count, but only those that are taken: none before the first
    success."""
    average_updates: int = 0
    """Updates over which the parameters that act in evaluation are averaged. With 0 the last ones
    act, as in the paper."""
    adam_epsilon: float = 1e-5
    """Constant added to the denominator of Adam."""
    max_grad_norm: float = 10.0
    """Largest norm of each network's gradient. Larger gradients are scaled down to it."""
    num_epochs: int = 15
    """Passes over each rollout."""
    num_minibatches: int = 1
    """Gradient steps per pass."""
    clip_epsilon: float = 0.2
    """Clip range of the ratio, and of the value's change in normalized units."""
    value_coef: float = 1.0
    """Weight of the value loss (lambda_c)."""
    huber_delta: float = 10.0
    """Error at which the value loss turns from quadratic to linear, in normalized units."""
    discount: float = 0.99
    """gamma: per environment step for the low level, per segment for the high level."""
    gae_lambda: float = 0.95
    """lambda of GAE, at both levels."""
    bootstrap_truncation: bool = False
    """If True, an episode cut by its time limit is bootstrapped from its last state. The paper's
    code base treats time limits as terminal."""
    hidden_size: int = 64
    """Width of every layer and of the recurrent memory."""
    sequence_length: int = 10
    """L, steps of backpropagation through time. Rollouts are cut into sequences of this length."""

    @property
    def steps_per_update(self) -> int:
        """Gradient steps of PPO per rollout."""
        return self.num_epochs * self.num_minibatches

    def __post_init__(self) -> None:
        check_types(self)
        counts = ("num_envs", "rollout_length", "num_epochs", "num_minibatches")
        check_range(self, *counts, "sequence_length", low=1)
        check_range(self, "hidden_size", low=1, high=2**16)
        if self.num_envs * self.rollout_length > LARGEST:
            raise ValueError(
                f"num_envs x rollout_length must be at most {LARGEST}, got {self.num_envs} x "
                f"{self.rollout_length}"
            )
        check_range(self, "decay_updates", low=0, high=10**6)
        check_range(self, "average_updates", low=0, high=10**4)  # Decays are float32.
        check_range(self, "learning_rate", "clip_epsilon", low=0)
        check_range(self, "adam_epsilon", "max_grad_norm", low=SMALLEST)
        check_range(self, "value_coef", "huber_delta", low=0)
        check_range(self, "discount", "gae_lambda", low=0, high=1)

    def check_sequences(self) -> None:
        """Check that minibatches of whole sequences fill a rollout, for networks with a memory.

        Raises:
            ValueError: They do not.
        """
        check_multiple(
            "ppo.rollout_length", self.rollout_length, "ppo.sequence_length", self.sequence_length
        )
        sequences = self.num_envs * (self.rollout_length // self.sequence_length)
        sequences_name = "num_envs x rollout_length / sequence_length"
        check_divides("ppo.num_minibatches", self.num_minibatches, sequences_name, sequences)


def has_choice(action_mask: Bool[Array, "*batch N actions"]) -> Bool[Array, "*batch N"]:
    """Mark agents with more than one legal action: the active agents of on-policy.

    The dead can only do nothing. The ratio of an only action is 1 for all parameters, so that it
    has no policy gradient. Leaving such steps out changes the number that a mean divides by, never
    the gradient of a step, even where a living agent has no choice.
    """
    return action_mask.sum(-1) > 1


def masked_mean(
    x: Float[Array, "*batch"], active: Bool[Array, "*batch"] | None = None
) -> Float[Array, ""]:
    """Average the active entries (0 if there are none), or all entries without a mask."""
    if active is None:
        return x.mean()
    return jnp.where(active, x, 0.0).sum() / jnp.maximum(active.sum(), 1)


def policy_loss(
    log_prob: Float[Array, "*batch"],
    old_log_prob: Float[Array, "*batch"],
    advantage: Float[Array, "*batch"],
    clip_epsilon: float,
    active: Bool[Array, "*batch"] | None = None,
) -> Float[Array, ""]:
    """Eq. 5: L(theta) = -E[min(rho A, clip(rho, 1 - eps, 1 + eps) A)], rho = pi / pi_old.

    The mean is over all axes, or over the entries that are `active`.
    """
    ratio = jnp.exp(log_prob - old_log_prob)
    clipped = jnp.clip(ratio, 1.0 - clip_epsilon, 1.0 + clip_epsilon)
    return -masked_mean(jnp.minimum(ratio * advantage, clipped * advantage), active)


def value_loss(
    value: Float[Array, "*#batch"],
    old_value: Float[Array, "*#batch"],
    target: Float[Array, "*#batch"],
    clip_epsilon: float,
    huber_delta: float,
) -> Float[Array, ""]:
    """Eq. 5: L(phi) = E[max{h(V - R), h(V_old + clip(V - V_old, -eps, eps) - R)}].

    h is the Huber loss (Table 1), e^2/2 near 0. All inputs are in normalized units and broadcast
    against each other; the mean is over all axes.
    """
    clipped = old_value + jnp.clip(value - old_value, -clip_epsilon, clip_epsilon)
    losses = [optax.losses.huber_loss(v, target, delta=huber_delta) for v in (value, clipped)]
    return jnp.maximum(*losses).mean()


def ppo_loss(
    log_prob: Float[Array, "*batch"],
    old_log_prob: Float[Array, "*batch"],
    advantage: Float[Array, "*batch"],
    value: Float[Array, "*#values"],
    old_value: Float[Array, "*#values"],
    target: Float[Array, "*#values"],
    config: PPOConfig,
    active: Bool[Array, "*batch"] | None = None,
) -> tuple[Float[Array, ""], Metrics]:
    """Eq. 5: L_PPO = L(theta) + lambda_c L(phi).

    Args:
        log_prob: log-probabilities of the taken actions under the policy that learns.
        old_log_prob: the same under the policy that acted.
        advantage: normalized advantages.
        value: values of the critic that learns, in normalized units.
        old_value: values of the critic when acting, in normalized units.
        target: returns in normalized units. Values and returns broadcast against each other.
        config: clip range, value coefficient and Huber threshold.
        active: entries that the policy loss averages, by default all. The value loss averages all
            entries, like on-policy's scripts for SMAC: the dead still share the team's return.

    Returns:
        The loss, and its parts with the usual diagnostics: the largest |ratio - 1|, and means of
        the others over all entries. Entries that are not `active` have a ratio of 1.
    """
    actor = policy_loss(log_prob, old_log_prob, advantage, config.clip_epsilon, active)
    critic = value_loss(value, old_value, target, config.clip_epsilon, config.huber_delta)
    ratio = jnp.exp(log_prob - old_log_prob)
    metrics = {
        "policy_loss": actor,
        "value_loss": critic,
        "ratio_error": abs(ratio - 1.0).max(),
        "clip_fraction": (abs(ratio - 1.0) > config.clip_epsilon).mean(),
        "approx_kl": (ratio - 1.0 - (log_prob - old_log_prob)).mean(),
    }
    return actor + config.value_coef * critic, metrics
