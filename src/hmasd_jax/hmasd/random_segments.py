"""Segments whose skills are drawn at random in training.

A coordinator that learns comes to prefer a few skills. The low level then forgets the others, and
q_d may tell a skill from when the coordinator assigns it. A team that solves its task can afford to
practice: in some segments all skills have the same chance, the prior of DIAYN (Eysenbach et al.,
2019). All skills learn to succeed there, and are paid for being different.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hmasd_jax.exploration.greedy_copies import leave_out, mark_greedy
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.coordinator import Assignment, Coordinator
from hmasd_jax.networks.transformer import draw_in_turn
from hmasd_jax.rl.keys import key_beside
from hmasd_jax.types import Key


def mark_random(
    config: HMASDConfig, share: float | Float[Array, ""], key: Key
) -> bool | Bool[Array, " E"]:
    """Mark copies in which a segment that begins draws skills at random; False if none ever does.

    Copies that act greedily keep the coordinator's choice.
    """
    if config.solved.random_share == 0:
        return False
    random = jax.random.bernoulli(key_beside(key, 1), share, (config.ppo.num_envs,))
    return leave_out(random, mark_greedy(config))


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
