"""Random play as a policy."""

import envs_jax
from hmasd_jax.types import Policy


def _step(memory, timestep, first, key):
    return memory, envs_jax.random_actions(key, timestep.action_mask), ()


RANDOM = Policy(lambda batch_shape: (), _step)
"""Uniform over the legal actions, without memory."""
