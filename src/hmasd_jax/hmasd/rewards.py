"""Rewards of the two levels: r^h (Sec. 3.2) and r^i (Eq. 4)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hmasd_jax.hmasd.config import HMASDConfig


def low_level_reward(
    reward: Float[Array, "*batch"],
    log_q_team: Float[Array, "*batch"],
    log_q_individual: Float[Array, "*batch N"],
    config: HMASDConfig,
) -> Float[Array, "*batch N"]:
    """Eq. 4: r^i = lambda_e r + lambda_D log q_D(Z|s') + lambda_d log q_d(z^i|o^i', Z).

    s' and o' are what step t led to, s_{t+1} and o_{t+1}.

    Args:
        reward: team reward r_t.
        log_q_team: log q_D of the team skill in use.
        log_q_individual: log q_d of each agent's skill in use.
        config: the three coefficients; with `skill_prior`, log p of a uniform prior is subtracted
            from each log q, so that a useless discriminator pays 0.
    """
    if config.skill_prior:
        log_q_team = log_q_team + jnp.log(config.num_team_skills)
        log_q_individual = log_q_individual + jnp.log(config.num_skills)
    shared = config.extrinsic_coef * reward + config.team_intrinsic_coef * log_q_team
    return shared[..., None] + config.individual_intrinsic_coef * log_q_individual


def high_level_reward(
    reward: Float[Array, "k *batch"], done: Bool[Array, "k *batch"], config: HMASDConfig
) -> tuple[Float[Array, "*batch"], Bool[Array, "*batch"]]:
    """Sec. 3.2: r_t^h = sum_{p=0}^{k-1} r_{t+p}, undiscounted; and whether the segment ended.

    By `segment_end`: `interval` sums over all k steps and is done only if an episode ended with
    the last of them; `episode` sums up to the first episode end and is done if there was one.
    """
    if config.segment_end == "interval":
        return reward.sum(0), done[-1]
    ended_before = jnp.cumsum(done, axis=0) - done > 0
    return jnp.where(ended_before, 0.0, reward).sum(0), done.any(0)
