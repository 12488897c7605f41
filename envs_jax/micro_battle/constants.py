"""What stays the same throughout a battle of `micro_battle`, as arrays with a row per unit."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from envs_jax.micro_battle.scenarios import Scenario
from envs_jax.micro_battle.unit_types import TICKS_PER_SECOND, UNIT_TYPES, Balance, UnitType

RESPONSE_RANGE = 9.0
"""Up to where a hit makes an enemy that walks turn to the shooter, in cells."""


class Roster(NamedTuple):
    """What stays of all units: rows (units, 1, ..), and for pairs (units, units, 1, ..)."""

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
    """Ticks without walking from when an attack begins."""
    shield_regeneration: np.ndarray
    health_regeneration: np.ndarray
    cooldown_scale: np.ndarray
    reach: np.ndarray
    """Of each unit to each other, from center to center."""
    scan: np.ndarray
    response: np.ndarray
    """Up to where a hit makes the unit turn to the shooter."""
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

    def row(name: str, factor: float = 1.0) -> np.ndarray:
        return np.array([getattr(t, name) for t in types], np.float32) * np.float32(factor)

    def pairs(entry: Callable[[UnitType, UnitType], float]) -> np.ndarray:
        return np.array([[entry(a, b) for b in types] for a in types], np.float32)

    ticks = TICKS_PER_SECOND
    windup, second_hit = np.ceil(row("windup", ticks)), np.ceil(row("second_hit", ticks))
    is_enemy = np.arange(len(types)) >= len(scenario.allies)
    reach = pairs(lambda a, b: a.reach + a.radius + b.radius)
    roster = Roster(
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
    return Roster(*(column(array, copies_ndim) for array in roster))


def column(constants: np.ndarray, copies_ndim: int) -> np.ndarray:
    """Shape constants so that they broadcast over axes of copies behind theirs."""
    return constants.reshape(constants.shape + (1,) * copies_ndim)


def _yielding(a: UnitType, b: UnitType) -> float:
    """Two units that move take half of a push each; what stands fast takes nothing of it."""
    return 0.0 if not a.speed else 0.5 if b.speed else 1.0
