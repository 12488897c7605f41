"""Coefficients of Eqs. 4, 6 and 7, and of the coordinator's learning rate, that change in training.

The paper keeps them constant. Each function returns a constant of Python where its settings leave
the coefficient constant. A traced number would round the whole update differently.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hmasd_jax.exploration.solved import actions_entropy_coef, solved_chance
from hmasd_jax.hmasd.components import Parts
from hmasd_jax.hmasd.discriminators import balance, weigh


def _solved(parts: Parts, bonus_state: Any) -> float | Float[Array, ""]:
    """Return p, the chance that the episodes of all copies of the environment are solved."""
    return solved_chance(parts.bonus, bonus_state, parts.config)


def skill_weight(
    parts: Parts,
    bonus_state: Any,
    team_reward: Float[Array, "T E"],
    unknown: float | Float[Array, ""],
) -> float | Float[Array, ""]:
    """Return the factor of the rewards for skills.

    Rewards for skills are noise to a team that has yet to solve its task. A team that solves it can
    afford them: skills become different ways to solve it, instead of none. SMERL pays skills in
    nearly optimal episodes only, for the same end (Kumar et al., NeurIPS 2020). Skills that can be
    told apart already gain no more weight.

    Args:
        parts: static components.
        bonus_state: state of the bonus, which counts the episodes that are solved.
        team_reward: team reward of every step of the rollout.
        unknown: `unknown_share` of q_d.
    """
    gain = parts.config.solved.skill_gain
    if gain == 0:
        return 1.0
    earned = parts.config.extrinsic_coef * jnp.maximum(team_reward.mean(), 0.0)
    solved = _solved(parts, bonus_state)
    return 1.0 + gain * solved * earned * unknown


def unknown_share(
    log_q: Float[Array, "*batch"], weight: Float[Array, "*batch"] | None, num_skills: int
) -> Float[Array, ""]:
    """Return the part of a uniform choice of skills that q does not know, in [0, 1].

    It is the cross-entropy of q in units of ln n_z: 1 for a q that cannot tell skills apart, 0 for
    one that always can, and 0 for a single skill.

    Args:
        log_q: log q of the skills in use.
        weight: weights of the samples; None if all weigh alike.
        num_skills: n_z.
    """
    cross_entropy = -weigh(log_q, weight).mean()
    return jnp.clip(cross_entropy / jnp.log(max(num_skills, 2)), 0.0, 1.0)


def sample_weight(
    parts: Parts, bonus_state: Any, skills: Int[Array, "B tokens"]
) -> Float[Array, "B N"] | None:
    """Return the weights of samples of q_d, which may become those of `balance` on a solved task.

    None stands for equal weights without the setting. Until the task is solved, q_d may follow the
    preferences of the coordinator, as in the paper.
    """
    whole = parts.config.solved.balance
    if whole == 0:
        return None
    degree = whole * _solved(parts, bonus_state)
    return 1.0 + degree * (balance(skills, parts.config) - 1.0)


def random_share(parts: Parts, bonus_state: Any) -> float | Float[Array, ""]:
    """Return the share of segments that draw skills at random; the number 0 without the setting."""
    share = parts.config.solved.random_share
    return share * _solved(parts, bonus_state) if share else 0.0


def high_entropy_coef(parts: Parts, bonus_state: Any) -> float | Float[Array, ""]:
    """Return lambda_h, which may rise once the task is solved."""
    config = parts.config
    if config.solved.high_entropy_coef == 0:
        return config.high_entropy_coef
    solved = _solved(parts, bonus_state)
    return config.high_entropy_coef + config.solved.high_entropy_coef * solved


def coordinator_step_factor(parts: Parts, bonus_state: Any) -> float | Float[Array, ""]:
    """Return the factor of the coordinator's learning rate, which may fall as episodes are solved.

    The reason is that of `exploration.solved.step_factor`. The noise would change the
    assignments that the team needs.
    """
    factor = parts.config.solved.coordinator_step_factor
    if factor == 1:
        return 1.0
    return factor + (1.0 - factor) * parts.bonus.unsolved(bonus_state)


def low_entropy_coef(
    parts: Parts,
    bonus_state: Any,
    num_updates: Int[Array, ""],
    unknown: float | Float[Array, ""],
) -> float | Float[Array, ""]:
    """Return lambda_l, which may fall with the updates and as episodes are solved.

    Where q_d cannot tell the skills of a solved task apart, it may rise: actions that hardly vary
    leave the rewards for skills nothing to choose from.

    Args:
        parts: static components.
        bonus_state: state of the bonus, which counts the episodes that are solved.
        num_updates: updates so far.
        unknown: `unknown_share` of q_d.
    """
    config = parts.config
    coef = actions_entropy_coef(parts.bonus, bonus_state, config, config.low_entropy_coef)
    if config.solved.low_entropy_coef > 0:
        solved = _solved(parts, bonus_state)
        coef = coef + config.solved.low_entropy_coef * solved * unknown
    if not config.low_entropy_decay_updates:
        return coef
    remaining = 1.0 - num_updates / config.low_entropy_decay_updates
    return coef * jnp.maximum(remaining, 0.0)
