"""Rewards of the two levels: r^h (Sec. 3.2) and r^i (Eq. 4)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.rl.gae import reward_to_go


def low_level_reward(
    reward: Float[Array, "*batch"],
    log_q_team: Float[Array, "*batch"],
    log_q_individual: Float[Array, "*batch N"],
    config: HMASDConfig,
    skill_weight: float | Float[Array, ""] = 1.0,
) -> Float[Array, "*batch N"]:
    """Eq. 4: r^i = lambda_e r + lambda_D log q_D(Z|s') + lambda_d log q_d(z^i|o^i', Z).

    s' and o' are the state and observations after step t, s_{t+1} and o_{t+1}.

    Args:
        reward: team reward r_t.
        log_q_team: log q_D of the team skill in use.
        log_q_individual: log q_d of each agent's skill in use.
        config: the three coefficients. With `skill_prior`, log p of a uniform prior is subtracted
            from each log q, so that a useless discriminator pays 0.
        skill_weight: factor of lambda_D and lambda_d.
    """
    if config.skill_prior:
        log_q_team = log_q_team + jnp.log(config.num_team_skills)
        log_q_individual = log_q_individual + jnp.log(config.num_skills)
    team_coef = skill_weight * config.team_intrinsic_coef
    individual_coef = skill_weight * config.individual_intrinsic_coef
    shared = config.extrinsic_coef * reward + team_coef * log_q_team
    return shared[..., None] + individual_coef * log_q_individual


def high_level_reward(
    reward: Float[Array, "T *batch"], last: Bool[Array, "T *batch"]
) -> Float[Array, "T *batch"]:
    """Sec. 3.2: r_t^h = sum_{p=0}^{k-1} r_{t+p}, the undiscounted reward of a segment.

    Args:
        reward: team reward of every step.
        last: True at the last step of a segment.

    Returns:
        The sum from each step to the end of its segment, which is r^h at a segment's first step.
    """
    return reward_to_go(reward, last, discount=1.0)
