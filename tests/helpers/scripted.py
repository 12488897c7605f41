"""A scripted policy with skills for Alice_and_Bob, whose results are known in advance."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs_jax.alice_and_bob import AliceAndBob
from hmasd_jax.config import TrainConfig
from hmasd_jax.hmasd import HMASDConfig
from hmasd_jax.runs.load import TrainedRun
from hmasd_jax.types import Algorithm, Policy

LEFT, UP, DOWN, RIGHT = 1, 2, 3, 0
CORNERS = np.array([(UP, LEFT), (UP, RIGHT), (DOWN, LEFT), (DOWN, RIGHT)])
"""Moves by which skill z reaches its corner: blue button, red button, red and blue diamond."""
TEAMS = np.array([(1, 2), (0, 3)])
"""Skills of Alice and Bob under Z = 0 (the red diamond) and Z = 1 (the blue one)."""


class Memory(NamedTuple):
    time: jax.Array
    skills: jax.Array


def scripted_policy(state, greedy=True, skills=None, allowed=None) -> Policy:
    """Skills that walk to a corner; Z changes every 20 steps, so that both diamonds are got."""
    if skills is not None:
        allowed = jnp.array([[h is None or z == h for z in range(4)] for h in skills])
    elif allowed is None:
        allowed = jnp.ones((3, 4), bool)

    def choose(wanted, token):
        """Return the wanted skill, or else the first allowed one."""
        scores = allowed[token] * (1 + jax.nn.one_hot(wanted, 4))
        return scores.argmax(-1)

    def step(memory, timestep, first, key):
        time = jnp.where(first, 0, memory.time)
        team_skill = choose(time // 20 % 2, 0)
        wanted = jnp.asarray(TEAMS)[team_skill]
        chosen = jnp.stack([team_skill, choose(wanted[:, 0], 1), choose(wanted[:, 1], 2)], axis=1)
        action = jnp.asarray(CORNERS)[chosen[:, 1:], time[:, None] % 2]
        return Memory(time + 1, chosen), action, chosen

    return Policy(lambda batch: Memory(jnp.zeros(batch, int), jnp.zeros((*batch, 3), int)), step)


def scripted_run() -> TrainedRun:
    """Return a trained run with the scripted policy and no parameters."""
    config = TrainConfig(env=AliceAndBob(), algorithm=HMASDConfig(skill_interval=20))
    algorithm = Algorithm(lambda key: None, lambda state: (state, {}), scripted_policy)
    return TrainedRun(config, config.env, algorithm, None, 1600)
