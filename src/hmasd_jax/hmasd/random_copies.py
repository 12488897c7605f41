"""Copies of the environment that draw all skills at random in training.

A coordinator that learns comes to prefer a few skills. The low level then forgets the others, and
no discriminator can tell them apart. Once the team solves its task it can afford to practice them:
a few copies draw every skill with the same chance, the prior of DIAYN (Eysenbach et al., 2019). All
skills learn to succeed there, and are paid for being different.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool

from hmasd_jax.exploration.bonus import Bonus, all_solved
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.coordinator import Assignment, Coordinator
from hmasd_jax.networks.transformer import draw_in_turn
from hmasd_jax.rl.categorical import mask_logits
from hmasd_jax.rl.keys import key_beside
from hmasd_jax.types import Key


def mark_random(config: HMASDConfig, bonus: Bonus, bonus_state: Any) -> bool | Bool[Array, " E"]:
    """Mark the copies that draw skills at random; False if there is never one.

    They are the last copies. Their number is `solved_random_copies` times the chance that a reward
    ends the episodes of all copies, rounded.
    """
    count, num_envs = config.solved_random_copies, config.ppo.num_envs
    if count == 0:
        return False
    marked = jnp.round(count * all_solved(bonus, bonus_state, num_envs))
    return jnp.arange(num_envs) >= num_envs - marked


def judge_others(bonus: Bonus, config: HMASDConfig) -> Bonus:
    """Return the bonus, with unsolved episodes counted in copies that never draw at random.

    The task is solved if the coordinator's choices solve it.
    """
    count, num_envs = config.solved_random_copies, config.ppo.num_envs
    if count == 0:
        return bonus
    others = jnp.arange(num_envs) < num_envs - count

    def unsolved(bonus_state, copies=True):
        return bonus.unsolved(bonus_state, copies & others)

    return bonus._replace(unsolved=unsolved)


def replace_skills(
    network: Coordinator, fresh: Assignment, key: Key, chosen: bool | Bool[Array, " E"]
) -> Assignment:
    """Replace the skills of copies by random ones.

    Args:
        network: coordinator, which knows the legal skills.
        fresh: skills that it chose.
        key: key of its draws. The random skills use a key beside those.
        chosen: True for the copies to replace.
    """
    if chosen is False:
        return fresh

    def same_logits(skills):
        legal = network.legal_skills(skills)
        return mask_logits(jnp.zeros((*skills.shape, network.max_skills)), legal)

    shape = fresh.skills.shape
    skills, log_prob = draw_in_turn(same_logits, shape, key_beside(key, 0))
    chosen = jnp.asarray(chosen)[:, None]
    return fresh._replace(
        skills=jnp.where(chosen, skills, fresh.skills),
        log_prob=jnp.where(chosen, log_prob, fresh.log_prob),
    )
