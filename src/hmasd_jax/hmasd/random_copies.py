"""Copies of the environment that draw all skills at random in training.

A coordinator that learns comes to prefer a few skills. The low level then forgets the others, and
no discriminator can tell them apart. So a few copies may draw every skill with the same chance, the
prior of DIAYN (Eysenbach et al., 2019). All skills learn to succeed there, and are paid for being
different.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool

from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.coordinator import Assignment, Coordinator
from hmasd_jax.networks.transformer import draw_in_turn
from hmasd_jax.rl.keys import key_beside
from hmasd_jax.types import Key


def mark_random(config: HMASDConfig) -> bool | Bool[Array, " E"]:
    """Mark the copies that draw skills at random, which are the last; False if there is none."""
    num_envs, count = config.ppo.num_envs, config.random_copies
    return jnp.arange(num_envs) >= num_envs - count if count else False


def replace_skills(
    network: Coordinator, fresh: Assignment, key: Key, random: bool | Bool[Array, " E"]
) -> Assignment:
    """Replace the skills of copies by random ones.

    Args:
        network: coordinator, which knows the legal skills.
        fresh: skills that it chose.
        key: key of its draws. The random skills use a key beside those.
        random: True for the copies to replace.
    """
    if random is False:
        return fresh

    drawn = draw_in_turn(network.equal_logits, fresh.skills.shape, key_beside(key, 0))
    skills, log_prob = (
        jnp.where(jnp.asarray(random)[:, None], new, old)
        for new, old in zip(drawn, (fresh.skills, fresh.log_prob))
    )
    return fresh._replace(skills=skills, log_prob=log_prob)
