"""One tick of `micro_battle`, 1/16 s: targets, shots, hits, walking, collisions.

The first axis of arrays is units, allies before enemies, followed by any axes of copies:
(units, *copies), or (units, units, *copies) for pairs. Copies come last because the processor's
vector instructions work along the last axis. Units are looked up by comparing indices and reducing
instead of by gathers: XLA computes a reduction once, but repeats a chain of cheap operations for
each of its uses.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs_jax.micro_battle.constants import UnitConstants
from envs_jax.micro_battle.scenarios import Rectangle, is_floor
from envs_jax.micro_battle.unit_types import EARLIEST, LATEST, SHIELD_DELAY, TICKS_PER_SECOND

NOBODY = -1
"""Index that stands for no unit."""
RESPONSE_TICKS = TICKS_PER_SECOND
"""Ticks after a hit in which an enemy with nobody in reach turns to the shooter."""
GOAL_RADIUS = 0.3
"""Distance in cells from its goal at which an enemy stops."""
LONG_AGO = -1e4
"""Time in ticks of an event that has not happened yet."""
LEAST_WOUND = 0.5
"""Least damage of a hit to health, whatever the armor."""


class Units(NamedTuple):
    """State of all units. Times are in ticks from the start of the environment step."""

    x: Float[Array, "units *copies"]
    y: Float[Array, "units *copies"]
    health: Float[Array, "units *copies"]
    """Health. A unit with 0 or less is dead."""
    shield: Float[Array, "units *copies"]
    ready: Float[Array, "units *copies"]
    """Time at which the next attack can begin."""
    begun: Float[Array, "units *copies"]
    """Time at which the last attack began."""
    struck: Float[Array, "units *copies"]
    """Time at which the unit was last hit."""
    shooter: Int[Array, "units *copies"]
    """Index of the unit that hit it last."""
    target: Int[Array, "units *copies"]
    """Index of the unit that it attacks."""


class Orders(NamedTuple):
    """Orders for the allies. Rows of enemies are ignored."""

    target: Int[Array, "units *copies"]
    """Index of the unit to attack, walking there if necessary."""
    toward_x: Float[Array, "units *copies"]
    """x of the direction in which to walk, a vector of length 1 or 0."""
    toward_y: Float[Array, "units *copies"]
    """y of this direction."""


def tick(
    constants: UnitConstants,
    floor: tuple[Rectangle, ...],
    units: Units,
    orders: Orders,
    goal: Float[Array, "2 *copies"] | None,
    luck: Float[Array, "units *copies"],
    now: Float[Array, ""],
) -> Units:
    """Advance the battle by one tick.

    Args:
        constants: Constants of the units, shaped for the axes of copies.
        floor: Area in which units can walk.
        units: All units.
        orders: Orders for the allies.
        goal: Destination of enemies without a target; None if they stay.
        luck: Random number in [0, 1) that sets the delay of a weapon within its bounds. One number
            per environment step is enough, as no weapon can begin two attacks in eight ticks.
        now: Ticks since the start of the environment step.

    Returns:
        The units after the tick.
    """
    units = recover(constants, units, now)
    # Targets, attacks and moves all use the positions before this tick, so distances are computed
    # only once.
    away = length(units.x - units.x[:, None], units.y - units.y[:, None])
    units = units._replace(target=choose_targets(constants, units, away, orders, now))
    x, y = move(constants, floor, units, away, orders, goal, now)
    units, hits = attack(constants, units, away, luck, now)
    apply_hits = partial(take_hits, constants)
    # With few copies most ticks have no hit. On a CPU this branch skips them, and makes XLA compute
    # `hits` once instead of for each pair of units. An accelerator would only wait for the branch.
    units = jax.lax.platform_dependent(
        units, hits, now, cpu=partial(_if_any, apply_hits), default=apply_hits
    )
    return units._replace(x=x, y=y)


def _if_any(function: Callable, units: Units, hits: Array, now: Array) -> Units:
    """Call `function` if there are any hits at all."""
    return jax.lax.cond(hits.any(), function, lambda units, *_: units, units, hits, now)


def recover(constants: UnitConstants, units: Units, now: Array) -> Units:
    """Regenerate health, and shields of units that were not hit during `SHIELD_DELAY`."""
    alive = units.health > 0
    rested = alive & (now - units.struck >= SHIELD_DELAY * TICKS_PER_SECOND)
    health = jnp.minimum(units.health + constants.health_regeneration, constants.max_health)
    shield = jnp.minimum(units.shield + constants.shield_regeneration, constants.max_shield)
    return units._replace(
        health=jnp.where(alive, health, units.health),
        shield=jnp.where(rested, shield, units.shield),
    )


def choose_targets(
    constants: UnitConstants, units: Units, away: Array, orders: Orders, now: Array
) -> Int[Array, "units *copies"]:
    """Choose the target of each unit: by order for allies, by a fixed rule for enemies.

    An ally without an order attacks nobody. An enemy attacks the first of

    1. its current target, if alive and in reach;
    2. the ally that hit it within the last second, if alive and within 9 cells (in reach, for an
       enemy that cannot walk);
    3. the nearest ally within its scan range;
    4. nobody.

    A unit keeps its target while a hit of its attack is still to come. Rules 1, 3 and 4 are those
    of SMAC's maps, which order enemies to attack-move once. Rule 2 is inferred from SMAC's
    description of 2m_vs_1z ("alternating fire"), according to which a zealot turns to whoever hit
    it.
    """
    allies = np.s_[: int((~constants.is_enemy).sum())]
    index, alive = constants.index[allies], units.health[allies] > 0
    away = away[:, allies]  # (units, allies, *copies)
    hit_by = units.shooter[:, None] == index
    hit_by &= (now - units.struck <= RESPONSE_TICKS)[:, None]
    # Express the rules as one score per ally; the lowest wins.
    score = jnp.where(alive & (away <= constants.scan[:, allies]), away, jnp.inf)
    score = jnp.where(alive & hit_by & (away <= constants.response[:, allies]), -1, score)
    kept = (units.target[:, None] == index) & (away <= constants.reach[:, allies])
    score = jnp.where(alive & kept, -2, score)
    is_best = (score == score.min(1, keepdims=True)) & (score < jnp.inf)
    chosen = jnp.where(is_best, index, len(constants.index)).min(1)
    chosen = jnp.where(chosen == len(constants.index), NOBODY, chosen)
    holds = now - units.begun <= constants.windup + constants.second_hit
    return jnp.where(holds, units.target, jnp.where(constants.is_enemy, chosen, orders.target))


def attack(
    constants: UnitConstants,
    units: Units,
    away: Array,
    luck: Float[Array, "units *copies"],
    now: Array,
) -> tuple[Units, Bool[Array, "units *copies"]]:
    """Begin new attacks and continue those that have begun.

    Returns:
        The units, and for each unit whether it hits its target in this tick.
    """
    alive = units.health > 0
    in_reach = is_target(constants, units) & alive & (away <= constants.reach)
    possible = alive & in_reach.any(1)
    elapsed, until_hit = now - units.begun, constants.windup + constants.second_hit
    # A weapon with a wind-up misses a target that has left, and can attack again at once.
    misses = (constants.windup > 0) & (elapsed <= until_hit) & ~possible
    begins = possible & (elapsed > until_hit) & (units.ready <= now)
    lands = alive & (until_hit > 0) & (elapsed == until_hit) & ~misses
    delay = (EARLIEST + (LATEST - EARLIEST) * luck) * TICKS_PER_SECOND
    ready = jnp.where(begins, now + constants.period + delay, units.ready)
    begun = jnp.where(begins, now, units.begun)
    units = units._replace(
        ready=jnp.where(misses, now, ready), begun=jnp.where(misses, LONG_AGO, begun)
    )
    return units, lands | (begins & (constants.windup == 0))


def take_hits(
    constants: UnitConstants, units: Units, hits: Bool[Array, "units *copies"], now: Array
) -> Units:
    """Subtract the damage of hits, one attacker after the other, from shields and then health."""
    lands = hits[:, None] & is_target(constants, units)  # (attackers, victims, *copies)
    damage = jnp.where(lands, constants.damage, 0)
    total = wounds = 0
    for attacker in range(len(damage)):
        before, total = total, total + damage[attacker]
        left = jnp.maximum(total - jnp.maximum(units.shield, before), 0)
        wounds += jnp.where(left > 0, jnp.maximum(left - constants.armor, LEAST_WOUND), 0)
    last = jnp.where(lands, constants.index[:, None], NOBODY).max(0)
    is_hit = last != NOBODY
    return units._replace(
        health=units.health - wounds,
        shield=jnp.maximum(units.shield - damage.sum(0), 0),
        struck=jnp.where(is_hit, now, units.struck),
        shooter=jnp.where(is_hit, last, units.shooter),
    )


def move(
    constants: UnitConstants,
    floor: tuple[Rectangle, ...],
    units: Units,
    away: Array,
    orders: Orders,
    goal: Float[Array, "2 *copies"] | None,
    now: Array,
) -> tuple[Array, Array]:
    """Walk, and push overlapping units apart.

    A unit with a target walks to it until it is in reach. A unit without one walks as its orders or
    its goal say. Units slide along walls: a move into a wall keeps the part along one axis if that
    stays on the floor.

    Returns:
        The new x and y.
    """
    alive = units.health > 0
    is_free = alive & (now - units.begun >= constants.stand)
    pace = jnp.where(is_free, constants.speed, 0)
    attacked = is_target(constants, units) & alive
    chase = jnp.where(attacked & (away > constants.reach), pace[:, None], 0)
    overlap = jnp.where(alive & alive[:, None], jnp.maximum(constants.body - away, 0), 0)
    pull = (chase - overlap * constants.yielding) / jnp.maximum(away, 1e-3)
    dx = (pull * (units.x - units.x[:, None])).sum(1)
    dy = (pull * (units.y - units.y[:, None])).sum(1)

    toward_x, toward_y = orders.toward_x, orders.toward_y
    if goal is not None:
        goal_x, goal_y = goal[0] - units.x, goal[1] - units.y
        to_goal = length(goal_x, goal_y)
        scale = jnp.where(to_goal > GOAL_RADIUS, 1 / to_goal, 0)
        toward_x = jnp.where(constants.is_enemy, goal_x * scale, toward_x)
        toward_y = jnp.where(constants.is_enemy, goal_y * scale, toward_y)
    pace = jnp.where(attacked.any(1), 0, pace)
    x, y = units.x + dx + pace * toward_x, units.y + dy + pace * toward_y

    along_x = is_floor(floor, x, units.y)
    both, along_y = is_floor(floor, x, y), ~along_x & is_floor(floor, units.x, y)
    return jnp.where(both | along_x, x, units.x), jnp.where(both | along_y, y, units.y)


def points_left(units: Units) -> Float[Array, "units *copies"]:
    """Return the health and shield that each unit has left."""
    return jnp.maximum(units.health, 0) + units.shield


def is_target(constants: UnitConstants, units: Units) -> Bool[Array, "units units *copies"]:
    """Test for each pair whether the first unit attacks the second."""
    return units.target[:, None] == constants.index


def length(x: Array, y: Array) -> Array:
    """Return the length of a vector."""
    return jnp.sqrt(x * x + y * y)
