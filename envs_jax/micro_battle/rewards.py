"""Team rewards of `micro_battle`, from the units before and after an environment step."""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from envs_jax.micro_battle.constants import UnitConstants
from envs_jax.micro_battle.physics import Units, points_left

Reward = Literal["win", "kills", "damage"]

WIN = 200.0
KILL = 10.0
LOSS = -5.0
"""Points for the battle, for an enemy's death and for an ally's, in SMAC and in MASER's fork."""

SCALE: dict[Reward, float] = {"kills": 10.0, "damage": 20.0}
"""Factor of the points, after they are divided by the most that can be earned."""


def won(units: Units, num_agents: int) -> Bool[Array, "*copies"]:
    """Return whether an ally lives and no enemy does."""
    alive = units.health > 0
    return alive[:num_agents].any(0) & ~alive[num_agents:].any(0)


def team_reward(
    kind: Reward, before: Units, after: Units, constants: UnitConstants, num_agents: int
) -> Float[Array, "*copies"]:
    """Return the reward of one environment step.

    - `win`: 1 when the battle is won (HMASD, Sec. 4.2).
    - `kills`: 200 when it is won, 10 for each enemy that dies and -5 for each ally, times 10 (the
      fork of SMAC in Jiwonjeon9603/MASER).
    - `damage`: 200 when it is won, 10 for each enemy that dies, and 1 for each point of health and
      shield that enemies lose, times 20 (the default of oxwhirl/smac, which also pays for shields
      that recharge).

    The last two are divided by the most that can be earned. As in their sources, it contains the
    health and shields of all enemies in both.

    Args:
        kind: Name of the reward.
        before: Units before the step.
        after: Units after the step.
        constants: Constants of the units.
        num_agents: Number of allies, which come first.
    """
    win = (won(after, num_agents) & ~won(before, num_agents)).astype(jnp.float32)
    if kind == "win":
        return win
    dies = (before.health > 0) & (after.health <= 0)
    allies, enemies = dies[:num_agents].sum(0), dies[num_agents:].sum(0)
    points = (constants.max_health + constants.max_shield)[num_agents:]
    scale = SCALE[kind] / (WIN + KILL * len(points) + float(points.sum()))
    if kind == "kills":
        return scale * (WIN * win + KILL * enemies + LOSS * allies)
    was, left = points_left(before), points_left(after)
    change = jnp.where(before.health > 0, was - left, 0)[num_agents:].sum(0)
    return scale * (WIN * win + jnp.abs(KILL * enemies + change))
