"""Constants of the units in a battle of `micro_battle`, as arrays with a row per unit."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from envs_jax.micro_battle.scenarios import Scenario
from envs_jax.micro_battle.unit_types import TICKS_PER_SECOND, UNIT_TYPES, Balance, UnitType

RESPONSE_RANGE = 9.0
"""Distance in cells up to which an enemy that can walk turns to whoever hit it."""


class UnitConstants(NamedTuple):
    """Constants of all units.

    Shapes are (units, 1, ...), or (units, units, 1, ...) for pairs, with as many trailing axes as
    there are axes of copies. Distances are in cells and times in ticks.
    """

    index: np.ndarray
    is_enemy: np.ndarray
    max_health: np.ndarray
    max_shield: np.ndarray
    armor: np.ndarray
    speed: np.ndarray
    """Cells per tick."""
    period: np.ndarray
    windup: np.ndarray
    second_hit: np.ndarray
    stand: np.ndarray
    """Ticks for which a unit does not walk after it begins an attack."""
    shield_regeneration: np.ndarray
    """Points per tick."""
    health_regeneration: np.ndarray
    """Points per tick."""
    cooldown_scale: np.ndarray
    reach: np.ndarray
    """Range of the first unit's weapon to the second, from center to center."""
    scan: np.ndarray
    """Range in which the first unit looks for targets, from center to center."""
    response: np.ndarray
    """Distance up to which the first unit turns to the second if that hit it."""
    damage: np.ndarray
    """Damage of one hit of the first unit on the second, before armor."""
    body: np.ndarray
    """Distance of two centers below which the units are pushed apart."""
    yielding: np.ndarray
    """Share of the push that the first unit takes."""


@lru_cache
def unit_constants(scenario: Scenario, balance: Balance, copies_ndim: int = 0) -> UnitConstants:
    """Return the constants of a scenario, shaped for `copies_ndim` axes of copies."""
    spawns = (*scenario.allies, *scenario.enemies)
    types = [UNIT_TYPES[balance][spawn.unit] for spawn in spawns]

    def row(name: str, factor: float = 1.0) -> np.ndarray:
        return np.array([getattr(t, name) for t in types], np.float32) * np.float32(factor)

    def pairs(entry: Callable[[UnitType, UnitType], float]) -> np.ndarray:
        return np.array([[entry(a, b) for b in types] for a in types], np.float32)

    ticks = TICKS_PER_SECOND
    windup, second_hit = np.ceil(row("windup", ticks)), np.ceil(row("second_hit", ticks))
    is_enemy = np.arange(len(types)) >= len(scenario.allies)
    reach = pairs(lambda a, b: a.reach + a.radius + b.radius)
    constants = UnitConstants(
        index=np.arange(len(types)),
        is_enemy=is_enemy,
        max_health=row("health"),
        max_shield=row("shield"),
        armor=row("armor"),
        speed=row("speed", 1 / ticks),
        period=row("period", ticks),
        windup=windup,
        second_hit=second_hit,
        stand=np.maximum(windup + second_hit, is_enemy * row("backswing", ticks)),
        shield_regeneration=row("shield_regeneration", 1 / ticks),
        health_regeneration=row("health_regeneration", 1 / ticks),
        cooldown_scale=row("cooldown_scale"),
        reach=reach,
        scan=pairs(lambda a, b: a.scan + a.radius + b.radius),
        response=np.where(row("speed")[:, None] > 0, RESPONSE_RANGE, reach),
        damage=pairs(lambda a, b: a.damage + b.armored * a.bonus),
        body=pairs(lambda a, b: a.body + b.body),
        yielding=pairs(_yielding) * (1 - np.eye(len(types), dtype=np.float32)),
    )
    return UnitConstants(*(column(array, copies_ndim) for array in constants))


def column(array: np.ndarray, copies_ndim: int) -> np.ndarray:
    """Append axes to an array, so that it broadcasts over trailing axes of copies."""
    return array.reshape(array.shape + (1,) * copies_ndim)


def _yielding(a: UnitType, b: UnitType) -> float:
    """Return the share of a push that `a` takes: half if both can move, none if `a` cannot."""
    return 0.0 if not a.speed else 0.5 if b.speed else 1.0
