"""One tick of `micro_battle`, a sixteenth of a second: targets, shots, hits, steps, collisions.

Arrays have units first, allies before enemies, and after that any axes of copies: (units, *copies),
or (units, units, *copies) for what a unit has to do with another. Copies last is where vector units
of a processor want them. Units are looked up by comparing indices and reducing, not by gathers: XLA
computes a reduction once, where it would repeat a chain of cheap operations in each of its uses.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs_jax.micro_battle.constants import Roster
from envs_jax.micro_battle.scenarios import Rectangle, is_floor
from envs_jax.micro_battle.unit_types import EARLIEST, LATEST, SHIELD_DELAY, TICKS_PER_SECOND

NOBODY = -1
"""In place of a unit's index."""
RESPONSE_TICKS = TICKS_PER_SECOND
"""How long a hit makes an enemy with nobody in reach turn to the shooter."""
GOAL_RADIUS = 0.3
LONG_AGO = -1e4
LEAST_WOUND = 0.5
"""What a hit takes off health at least, whatever the armor."""


class Units(NamedTuple):
    """What changes of all units. Times are in ticks from the start of the environment step."""

    x: Float[Array, "units *copies"]
    y: Float[Array, "units *copies"]
    health: Float[Array, "units *copies"]
    """0 or less is dead."""
    shield: Float[Array, "units *copies"]
    ready: Float[Array, "units *copies"]
    """When the next attack can begin."""
    begun: Float[Array, "units *copies"]
    """When the last one began."""
    struck: Float[Array, "units *copies"]
    """When the unit was last hit,"""
    shooter: Int[Array, "units *copies"]
    """and by whom."""
    target: Int[Array, "units *copies"]
    """Whom the unit attacks, by index in this array."""


class Orders(NamedTuple):
    """What allies are to do; enemies' rows are not looked at."""

    target: Int[Array, "units *copies"]
    """Whom to attack, walking there if need be."""
    toward_x: Float[Array, "units *copies"]
    toward_y: Float[Array, "units *copies"]
    """Direction to walk in, of length 1 or 0."""


def tick(
    roster: Roster,
    floor: tuple[Rectangle, ...],
    units: Units,
    orders: Orders,
    goal: Float[Array, "2 *copies"] | None,
    luck: Float[Array, "units *copies"],
    now: Float[Array, ""],
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
        now: ticks since the start of the environment step.
    """
    units = recover(roster, units, now)
    # All that follows happens where units stand now, so that distances are needed only once.
    away = length(units.x - units.x[:, None], units.y - units.y[:, None])
    units = units._replace(target=choose_targets(roster, units, away, orders, now))
    x, y = move(roster, floor, units, away, orders, goal, now)
    units, hits = attack(roster, units, away, luck, now)
    hurt = partial(take_hits, roster)
    # On a CPU, most ticks of few copies are over without a hit, and XLA then computes `hits` once
    # and not for each pair of units. An accelerator would only wait for the answer.
    units = jax.lax.platform_dependent(
        units, hits, now, cpu=partial(_where_any, hurt), default=hurt
    )
    return units._replace(x=x, y=y)


def _where_any(function: Callable, units: Units, hits: Array, now: Array) -> Units:
    """`function`, if there are any hits at all."""
    return jax.lax.cond(hits.any(), function, lambda units, *_: units, units, hits, now)


def recover(roster: Roster, units: Units, now: Array) -> Units:
    """Regenerate health, and shields that were not hit for a while."""
    alive = units.health > 0
    rested = alive & (now - units.struck >= SHIELD_DELAY * TICKS_PER_SECOND)
    health = jnp.minimum(units.health + roster.health_regeneration, roster.max_health)
    shield = jnp.minimum(units.shield + roster.shield_regeneration, roster.max_shield)
    return units._replace(
        health=jnp.where(alive, health, units.health),
        shield=jnp.where(rested, shield, units.shield),
    )


def choose_targets(
    roster: Roster, units: Units, away: Array, orders: Orders, now: Array
) -> Int[Array, "units *copies"]:
    """Give allies the targets they are ordered to attack, and enemies their own choice.

    An ally attacks nobody without an order. An enemy takes the first of

    1. its target, while that is alive and in reach;
    2. who hit it within the last second, alive and within 9 cells (in reach, if it cannot walk);
    3. the nearest ally within its scan range;
    4. nobody.

    A hit on its way holds the target. Rules 1, 3 and 4 are those of SMAC's maps, which order
    enemies to attack-move once; that a zealot turns to who hit it is inferred from SMAC's
    description of 2m_vs_1z ("alternating fire").
    """
    allies = np.s_[: int((~roster.is_enemy).sum())]
    index, alive = roster.index[allies], units.health[allies] > 0
    away = away[:, allies]  # (units, allies, *copies)
    hit_by = units.shooter[:, None] == index
    hit_by &= (now - units.struck <= RESPONSE_TICKS)[:, None]
    # The rules as one number, of which the least is taken.
    score = jnp.where(alive & (away <= roster.scan[:, allies]), away, jnp.inf)
    score = jnp.where(alive & hit_by & (away <= roster.response[:, allies]), -1, score)
    kept = (units.target[:, None] == index) & (away <= roster.reach[:, allies])
    score = jnp.where(alive & kept, -2, score)
    is_best = (score == score.min(1, keepdims=True)) & (score < jnp.inf)
    chosen = jnp.where(is_best, index, len(roster.index)).min(1)
    chosen = jnp.where(chosen == len(roster.index), NOBODY, chosen)
    holds = now - units.begun <= roster.windup + roster.second_hit
    return jnp.where(holds, units.target, jnp.where(roster.is_enemy, chosen, orders.target))


def attack(
    roster: Roster, units: Units, away: Array, luck: Float[Array, "units *copies"], now: Array
) -> tuple[Units, Bool[Array, "units *copies"]]:
    """Begin attacks and carry on with those that have begun.

    Returns:
        The units, and whether each lands a hit on its target now.
    """
    alive = units.health > 0
    in_reach = is_target(roster, units) & alive & (away <= roster.reach)
    possible = alive & in_reach.any(1)
    elapsed, until_hit = now - units.begun, roster.windup + roster.second_hit
    # Weapons with a wind-up miss whoever has left, and can attack anew at once.
    misses = (roster.windup > 0) & (elapsed <= until_hit) & ~possible
    begins = possible & (elapsed > until_hit) & (units.ready <= now)
    lands = alive & (until_hit > 0) & (elapsed == until_hit) & ~misses
    delay = (EARLIEST + (LATEST - EARLIEST) * luck) * TICKS_PER_SECOND
    ready = jnp.where(begins, now + roster.period + delay, units.ready)
    begun = jnp.where(begins, now, units.begun)
    units = units._replace(
        ready=jnp.where(misses, now, ready), begun=jnp.where(misses, LONG_AGO, begun)
    )
    return units, lands | (begins & (roster.windup == 0))


def take_hits(
    roster: Roster, units: Units, hits: Bool[Array, "units *copies"], now: Array
) -> Units:
    """Subtract what hits take, one attacker after the other: shields first, then health."""
    lands = hits[:, None] & is_target(roster, units)  # (attackers, victims, *copies)
    damage = jnp.where(lands, roster.damage, 0)
    total = wounds = 0
    for attacker in range(len(damage)):
        before, total = total, total + damage[attacker]
        left = jnp.maximum(total - jnp.maximum(units.shield, before), 0)
        wounds += jnp.where(left > 0, jnp.maximum(left - roster.armor, LEAST_WOUND), 0)
    last = jnp.where(lands, roster.index[:, None], NOBODY).max(0)
    is_hit = last != NOBODY
    return units._replace(
        health=units.health - wounds,
        shield=jnp.maximum(units.shield - damage.sum(0), 0),
        struck=jnp.where(is_hit, now, units.struck),
        shooter=jnp.where(is_hit, last, units.shooter),
    )


def move(
    roster: Roster,
    floor: tuple[Rectangle, ...],
    units: Units,
    away: Array,
    orders: Orders,
    goal: Float[Array, "2 *copies"] | None,
    now: Array,
) -> tuple[Array, Array]:
    """Walk and be pushed apart.

    A unit walks to its target if that is out of reach, else where orders or the goal say, and
    slides along walls: it goes as far as it can along each axis.

    Returns:
        New x and y.
    """
    alive = units.health > 0
    is_free = alive & (now - units.begun >= roster.stand)
    pace = jnp.where(is_free, roster.speed, 0)
    attacked = is_target(roster, units) & alive
    chase = jnp.where(attacked & (away > roster.reach), pace[:, None], 0)
    overlap = jnp.where(alive & alive[:, None], jnp.maximum(roster.body - away, 0), 0)
    pull = (chase - overlap * roster.yielding) / jnp.maximum(away, 1e-3)
    dx = (pull * (units.x - units.x[:, None])).sum(1)
    dy = (pull * (units.y - units.y[:, None])).sum(1)

    toward_x, toward_y = orders.toward_x, orders.toward_y
    if goal is not None:
        goal_x, goal_y = goal[0] - units.x, goal[1] - units.y
        to_goal = length(goal_x, goal_y)
        scale = jnp.where(to_goal > GOAL_RADIUS, 1 / to_goal, 0)
        toward_x = jnp.where(roster.is_enemy, goal_x * scale, toward_x)
        toward_y = jnp.where(roster.is_enemy, goal_y * scale, toward_y)
    pace = jnp.where(attacked.any(1), 0, pace)
    x, y = units.x + dx + pace * toward_x, units.y + dy + pace * toward_y

    along_x = is_floor(floor, x, units.y)
    both, along_y = is_floor(floor, x, y), ~along_x & is_floor(floor, units.x, y)
    return jnp.where(both | along_x, x, units.x), jnp.where(both | along_y, y, units.y)


def is_target(roster: Roster, units: Units) -> Bool[Array, "units units *copies"]:
    """Whether the first unit attacks the second."""
    return units.target[:, None] == roster.index


def length(x: Array, y: Array) -> Array:
    """Of a vector."""
    return jnp.sqrt(x * x + y * y)
