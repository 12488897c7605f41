"""One tick of `micro_battle`, a sixteenth of a second: targets, shots, hits, steps, collisions.

Arrays have units first, allies before enemies, and after that any axes of copies: (units, *copies).
Copies last is where a processor's vector units want them, and loops over the few units are written
out, so that all is arithmetic on whole rows of copies, without gathers or scatters.
"""

from functools import lru_cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from envs_jax.battle_scenarios import Rectangle, Scenario, is_floor
from envs_jax.battle_units import (
    EARLIEST,
    LATEST,
    SHIELD_DELAY,
    TICKS_PER_SECOND,
    UNIT_TYPES,
    Balance,
    UnitType,
)

NOBODY = -1
"""In place of a unit's index."""
RESPONSE_TICKS = TICKS_PER_SECOND
"""How long a hit makes an enemy with nobody in reach turn to the shooter."""
RESPONSE_RANGE = 9.0
GOAL_RADIUS = 0.3
LEAST_WOUND = 0.5
"""What a hit takes off health at least, whatever the armor."""


class Units(NamedTuple):
    """What changes of all units; times in ticks."""

    x: Float[Array, "units *copies"]
    y: Float[Array, "units *copies"]
    health: Float[Array, "units *copies"]
    """0 or less is dead."""
    shield: Float[Array, "units *copies"]
    cooldown: Float[Array, "units *copies"]
    """Until the next attack can begin."""
    rest: Float[Array, "units *copies"]
    """Until the unit can walk again."""
    swing: Float[Array, "units *copies"]
    """Until a hit lands that is on its way; 0 or less if none is."""
    target: Int[Array, "units *copies"]
    """Whom the unit attacks, by index in this array."""
    shooter: Int[Array, "units *copies"]
    """Who hit it last."""
    unharmed: Float[Array, "units *copies"]
    """Since that hit."""
    shot_at: Int[Array, "units *copies"]
    """At whom an attack began during this environment step."""


class Orders(NamedTuple):
    """What units are to do; enemies' are not looked at."""

    target: Int[Array, "units *copies"]
    """Whom to attack, walking there if need be."""
    toward_x: Float[Array, "units *copies"]
    toward_y: Float[Array, "units *copies"]
    """Direction to walk in, of length 1 or 0."""


class Roster(NamedTuple):
    """What stays of all units: rows (units, 1, ..), and for pairs (units, units, 1, ..)."""

    automatic: np.ndarray
    """Enemies: they choose their targets themselves."""
    max_health: np.ndarray
    max_shield: np.ndarray
    armor: np.ndarray
    speed: np.ndarray
    """Cells per tick."""
    period: np.ndarray
    windup: np.ndarray
    second_hit: np.ndarray
    stand: np.ndarray
    """Ticks without walking once an attack begins."""
    shield_regeneration: np.ndarray
    health_regeneration: np.ndarray
    cooldown_scale: np.ndarray
    reach: np.ndarray
    """Of each unit to each other, from center to center."""
    scan: np.ndarray
    damage: np.ndarray
    body: np.ndarray
    """Distance of a pair's centers below which it is pushed apart."""
    yielding: np.ndarray
    """Which part of the push the first of a pair takes."""


@lru_cache
def make_roster(scenario: Scenario, balance: Balance, copies_ndim: int = 0) -> Roster:
    """The constants of a scenario, shaped for so many axes of copies."""
    spawns = (*scenario.allies, *scenario.enemies)
    types = [UNIT_TYPES[balance][spawn.unit] for spawn in spawns]
    automatic = np.arange(len(spawns)) >= len(scenario.allies)

    def row(name: str, factor: float = 1.0) -> np.ndarray:
        return np.array([getattr(t, name) for t in types], np.float32) * np.float32(factor)

    def pairs(entry) -> np.ndarray:
        return np.array([[entry(a, b) for b in types] for a in types], np.float32)

    ticks = TICKS_PER_SECOND
    stand = np.where(automatic, row("backswing", ticks), 0)
    stand = np.maximum(stand, row("windup", ticks) + row("second_hit", ticks))
    roster = Roster(
        automatic=automatic,
        max_health=row("health"),
        max_shield=row("shield"),
        armor=row("armor"),
        speed=row("speed", 1 / ticks),
        period=row("period", ticks),
        windup=row("windup", ticks),
        second_hit=row("second_hit", ticks),
        stand=stand,
        shield_regeneration=row("shield_regeneration", 1 / ticks),
        health_regeneration=row("health_regeneration", 1 / ticks),
        cooldown_scale=row("cooldown_scale"),
        reach=pairs(lambda a, b: a.reach + a.radius + b.radius),
        scan=pairs(lambda a, b: a.scan + a.radius + b.radius),
        damage=pairs(lambda a, b: a.damage + b.armored * a.bonus),
        body=pairs(lambda a, b: a.body + b.body),
        yielding=pairs(_yielding) * (1 - np.eye(len(types), dtype=np.float32)),
    )
    return Roster(*(column(array, copies_ndim) for array in roster))


def column(constants: np.ndarray, copies_ndim: int) -> np.ndarray:
    """Shape constants so that they broadcast over axes of copies behind theirs."""
    return constants.reshape(constants.shape + (1,) * copies_ndim)


def _yielding(a: UnitType, b: UnitType) -> float:
    """Two units that move take half of a push each; what stands fast takes nothing of it."""
    return 0.0 if not a.speed else 0.5 if b.speed else 1.0


def tick(
    roster: Roster,
    floor: tuple[Rectangle, ...],
    units: Units,
    orders: Orders,
    goal: Float[Array, "2 *copies"] | None,
    luck: Float[Array, "units *copies"],
) -> Units:
    """Advance the battle by one tick.

    Args:
        roster: constants of the units, shaped for the copies at hand.
        floor: where units can walk.
        units: all units.
        orders: of the allies.
        goal: where enemies go that have no target; None to stay.
        luck: in [0, 1), where in its bounds the delay of a weapon is. One number per environment
            step is enough, as no weapon can begin two attacks in eight ticks.
    """
    units = recover(roster, units)
    units = units._replace(target=choose_targets(roster, units, orders))
    units, hits = attack(roster, units, luck)
    hurt = take_hits(roster, units, hits)
    return push_apart(roster, floor, walk(roster, floor, hurt, orders, goal))


def recover(roster: Roster, units: Units) -> Units:
    """Let a tick pass for all timers, and heal."""
    alive = units.health > 0
    unharmed = units.unharmed + 1
    healed = units.health + roster.health_regeneration
    restored = units.shield + roster.shield_regeneration
    rested = alive & (unharmed > SHIELD_DELAY * TICKS_PER_SECOND)
    return units._replace(
        health=jnp.where(alive, jnp.minimum(healed, roster.max_health), units.health),
        shield=jnp.where(rested, jnp.minimum(restored, roster.max_shield), units.shield),
        cooldown=units.cooldown - 1,
        rest=units.rest - 1,
        unharmed=unharmed,
    )


def choose_targets(roster: Roster, units: Units, orders: Orders) -> Int[Array, "units *copies"]:
    """Allies attack whom they are ordered to and nobody else. An enemy takes the first of

    1. its target, while that is alive and in reach;
    2. who hit it within the last second, alive and within 9 cells (in reach, if it cannot walk);
    3. the nearest ally within its scan range;
    4. nobody.

    A hit on its way holds the target. Rules 1, 3 and 4 are those of SMAC's maps, which order
    enemies to attack-move once; that a zealot turns to who hit it is inferred from SMAC's
    description of 2m_vs_1z ("alternating fire").
    """
    nearest, nearest_away = NOBODY, jnp.inf
    keeps = responds = False
    for index in range(int((~roster.automatic).sum())):
        away = distance(units.x[index] - units.x, units.y[index] - units.y)
        alive = units.health[index] > 0
        in_reach = alive & (away <= roster.reach[:, index])
        near = alive & (away <= RESPONSE_RANGE) & (roster.speed > 0)
        keeps |= (units.target == index) & in_reach
        responds |= (units.shooter == index) & (in_reach | near)
        closer = alive & (away <= roster.scan[:, index]) & (away < nearest_away)
        nearest = jnp.where(closer, index, nearest)
        nearest_away = jnp.where(closer, away, nearest_away)
    responds &= units.unharmed <= RESPONSE_TICKS
    chosen = jnp.where(responds, units.shooter, nearest)
    chosen = jnp.where(keeps, units.target, chosen)
    chosen = jnp.where(roster.automatic, chosen, orders.target)
    return jnp.where(units.swing > 0, units.target, chosen)


def attack(
    roster: Roster, units: Units, luck: Float[Array, "units *copies"]
) -> tuple[Units, Array]:
    """Begin attacks and carry on with those that are on their way.

    Returns:
        The units, and whether each lands a hit on its target now.
    """
    alive = units.health > 0
    possible = alive & (_of_target(units.target, units.health) > 0) & _in_reach(roster, units)
    on_its_way = units.swing > 0
    swing = units.swing - 1
    lands = alive & on_its_way & (swing <= 0)
    # Weapons with a wind-up miss whoever has left, and can attack anew at once.
    breaks_off = on_its_way & (roster.windup > 0) & ~possible
    begins = possible & ~on_its_way & (units.cooldown <= 0)
    delay = (EARLIEST + (LATEST - EARLIEST) * luck) * TICKS_PER_SECOND
    waiting = jnp.where(begins, roster.windup + roster.second_hit, swing)
    cooldown = jnp.where(begins, roster.period + delay, units.cooldown)
    units = units._replace(
        swing=jnp.where(breaks_off, 0, waiting),
        cooldown=jnp.where(breaks_off, 0, cooldown),
        rest=jnp.where(begins, roster.stand, units.rest),
        shot_at=jnp.where(begins, units.target, units.shot_at),
    )
    return units, (lands & ~breaks_off) | (begins & (roster.windup == 0))


def take_hits(roster: Roster, units: Units, hits: Array) -> Units:
    """Subtract what hits take, one attacker after the other: shields first, then health."""
    health, shield, shooter = units.health, units.shield, units.shooter
    unharmed = units.unharmed
    everyone = np.arange(len(roster.armor)).reshape(roster.armor.shape)
    for index in range(len(roster.armor)):
        struck = hits[index] & (units.target[index] == everyone)
        damage = roster.damage[index]
        left = damage - jnp.minimum(shield, damage)
        wound = jnp.where(left > 0, jnp.maximum(left - roster.armor, LEAST_WOUND), 0)
        health = jnp.where(struck, health - wound, health)
        shield = jnp.where(struck, jnp.maximum(shield - damage, 0), shield)
        shooter = jnp.where(struck, index, shooter)
        unharmed = jnp.where(struck, 0, unharmed)
    return units._replace(health=health, shield=shield, shooter=shooter, unharmed=unharmed)


def walk(
    roster: Roster,
    floor: tuple[Rectangle, ...],
    units: Units,
    orders: Orders,
    goal: Float[Array, "2 *copies"] | None,
) -> Units:
    """Walk to targets out of reach, else where orders or the goal say; slide along walls."""
    target_health = _of_target(units.target, units.health)
    engaged = (units.target != NOBODY) & (target_health > 0)
    dx = _of_target(units.target, units.x) - units.x
    dy = _of_target(units.target, units.y) - units.y
    chases = engaged & ~_in_reach(roster, units)
    toward_x, toward_y = orders.toward_x, orders.toward_y
    if goal is not None:
        goal_x, goal_y = goal[0] - units.x, goal[1] - units.y
        to_goal = distance(goal_x, goal_y)
        off = roster.automatic & (to_goal > GOAL_RADIUS)
        scale = 1 / jnp.maximum(to_goal, GOAL_RADIUS)
        toward_x = jnp.where(off, goal_x * scale, toward_x)
        toward_y = jnp.where(off, goal_y * scale, toward_y)
    scale = 1 / jnp.maximum(distance(dx, dy), 1e-3)
    toward_x = jnp.where(chases, dx * scale, jnp.where(engaged, 0, toward_x))
    toward_y = jnp.where(chases, dy * scale, jnp.where(engaged, 0, toward_y))
    pace = jnp.where((units.health > 0) & (units.rest <= 0), roster.speed, 0)
    return _move(floor, units, units.x + pace * toward_x, units.y + pace * toward_y)


def _move(floor: tuple[Rectangle, ...], units: Units, x: Array, y: Array) -> Units:
    """Move to (x, y) as far as walls allow: fully, else along one axis, else not at all."""
    both, along_x = is_floor(floor, x, y), is_floor(floor, x, units.y)
    along_y = ~both & ~along_x & is_floor(floor, units.x, y)
    return units._replace(
        x=jnp.where(both | along_x, x, units.x), y=jnp.where(both | along_y, y, units.y)
    )


def push_apart(roster: Roster, floor: tuple[Rectangle, ...], units: Units) -> Units:
    """Part living units that overlap, all at once, but push none into a wall."""
    alive = units.health > 0
    push_x = push_y = 0
    for index in range(len(roster.speed)):
        dx, dy = units.x - units.x[index], units.y - units.y[index]
        away = jnp.maximum(distance(dx, dy), 1e-3)
        overlap = jnp.maximum(roster.body[:, index] - away, 0) * roster.yielding[:, index]
        share = jnp.where(alive & alive[index], overlap / away, 0)
        push_x, push_y = push_x + dx * share, push_y + dy * share
    x, y = units.x + push_x, units.y + push_y
    free = is_floor(floor, x, y)
    return units._replace(x=jnp.where(free, x, units.x), y=jnp.where(free, y, units.y))


def distance(dx: Array, dy: Array) -> Array:
    """Length of a vector."""
    return jnp.sqrt(dx * dx + dy * dy)


def _of_target(target: Array, values: Array) -> Array:
    """Each unit's `values` of its target, 0 for nobody."""
    found = jnp.zeros_like(values)
    for index in range(len(values)):
        found = jnp.where(target == index, values[index], found)
    return found


def _in_reach(roster: Roster, units: Units) -> Array:
    """Whether each unit's weapon carries to its target; nobody is out of reach."""
    found = False
    for index in range(len(roster.speed)):
        away = distance(units.x[index] - units.x, units.y[index] - units.y)
        found |= (units.target == index) & (away <= roster.reach[:, index])
    return found
