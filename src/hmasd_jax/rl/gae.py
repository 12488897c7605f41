"""Generalized advantage estimation (Schulman et al., 2016), below Eq. 5."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from envs_jax import TimeStep
from hmasd_jax.rl.ppo import PPOConfig, masked_mean
from hmasd_jax.rl.rollout import following
from hmasd_jax.rl.value_norm import ValueNorm, denormalize


def gae(
    reward: Float[Array, "T *#batch"],
    value: Float[Array, "T *#batch"],
    next_value: Float[Array, "T *#batch"],
    terminated: Bool[Array, "T *#batch"],
    done: Bool[Array, "T *#batch"],
    discount: float,
    gae_lambda: float,
) -> tuple[Float[Array, "T *batch"], Float[Array, "T *batch"]]:
    """Compute advantages Â and targets R̂ = Â + V by backward recursion.

        δ_t = r_t + γ V'_t (1 - terminated_t) - V_t
        Â_t = δ_t + γ λ (1 - done_t) Â_{t+1}

    `next_value` V'_t is the value of the state after step t, before any reset. Where a time limit
    cut an episode (`done` without `terminated`), the target bootstraps from it, but no advantage
    flows back over the cut. To treat time limits as terminal, pass `terminated=done`. All values
    are in reward units (denormalized). Inputs broadcast against each other.
    """
    delta = reward + discount * next_value * (1.0 - terminated) - value
    carry_over = jnp.broadcast_to(discount * gae_lambda * (1.0 - done), delta.shape)

    def backward(next_advantage, step):
        delta, carry_over = step
        advantage = delta + carry_over * next_advantage
        return advantage, advantage

    _, advantage = jax.lax.scan(
        backward, jnp.zeros_like(delta[0]), (delta, carry_over), reverse=True
    )
    return advantage, advantage + value


def reward_to_go(
    reward: Float[Array, "T *batch"], last: Bool[Array, "T *batch"], discount: float
) -> Float[Array, "T *batch"]:
    """Sum the discounted rewards from each step to the next step that is a `last` one, or to T."""

    def backward(later, step):
        reward, last = step
        total = reward + discount * jnp.where(last, 0.0, later)
        return total, total

    return jax.lax.scan(backward, jnp.zeros_like(reward[0]), (reward, last), reverse=True)[1]


def rollout_advantage(
    reward: Float[Array, "T E #N"],
    value: Float[Array, "T E #N"],
    last_value: Float[Array, "E #N"],
    outcome: TimeStep,
    value_of_outcome: Callable[[], Float[Array, "T E #N"]],
    norm: ValueNorm,
    config: PPOConfig,
) -> tuple[Float[Array, "T E #N"], Float[Array, "T E #N"]]:
    """Compute advantages and targets of every step of a rollout with `gae`.

    Args:
        reward: rewards of the rollout, in reward units.
        value: values at each step. All values are in normalized units.
        last_value: values after the last step.
        outcome: results (T, E, ...) of each step before any reset.
        value_of_outcome: function that computes the values of `outcome`. It is called only with
            `bootstrap_truncation`.
        norm: units of the critic.
        config: discount, lambda, and the treatment of time limits.
    """
    next_value, terminated = values_after(value, last_value, outcome, value_of_outcome, config)
    return gae(
        reward,
        denormalize(norm, value),
        denormalize(norm, next_value),
        terminated,
        outcome.done[..., None],
        config.discount,
        config.gae_lambda,
    )


def values_after(
    value: Float[Array, "T E #N"],
    last_value: Float[Array, "E #N"],
    outcome: TimeStep,
    value_of_outcome: Callable[[], Float[Array, "T E #N"]],
    config: PPOConfig,
) -> tuple[Float[Array, "T E #N"], Bool[Array, "T E 1"]]:
    """Return the value of what each step led to, and whether that value counts as 0 instead.

    The arguments are those of `rollout_advantage`.
    """
    next_value, terminated = following(value, last_value), outcome.done
    if config.bootstrap_truncation:
        next_value = jnp.where(outcome.truncated[..., None], value_of_outcome(), next_value)
        terminated = outcome.terminated
    return next_value, terminated[..., None]


def normalize_advantage(
    advantage: Float[Array, "*batch"],
    active: Bool[Array, "*batch"] | None = None,
    floor: float = 0.0,
) -> Float[Array, "*batch"]:
    """Shift and scale by mean and population standard deviation over all axes.

    This matches on-policy `r_mappo.py`, which normalizes once per iteration, before the epochs, by
    statistics over the `active` agents. A deviation below `floor` is replaced by `floor`, so that
    tiny advantages stay small.
    """
    deviation = advantage - masked_mean(advantage, active)
    scale = jnp.sqrt(masked_mean(deviation**2, active)) + 1e-5
    return deviation / jnp.maximum(scale, floor)
