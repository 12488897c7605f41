"""Unit types of `micro_battle`: what each can take, how it moves and what its weapon does.

The numbers are those of StarCraft II's own data files (SC2Mapster/SC2GameData at 4.6.2 and 4.10,
where they agree), in cells and in seconds of the game at "normal" speed. Published tables mostly
give seconds at "faster" speed, which are 1.4 times as long: the two do not mix.
"""

from dataclasses import dataclass, replace
from typing import Literal

Balance = Literal["multi", "liberty"]

TICKS_PER_SECOND = 16
"""Ticks of the simulation (game loops) in a second at normal speed."""
SHIELD_DELAY = 10.0
"""Seconds without damage after which shields come back."""
EARLIEST, LATEST = -0.0625, 0.125
"""Bounds in seconds of the random time that every shot adds to its weapon's period."""


@dataclass(frozen=True)
class UnitType:
    """One type of unit; distances in cells, times in seconds."""

    health: float
    shield: float = 0.0
    armor: float = 0.0
    """Taken off every hit on health, not on shields."""
    armored: bool = False
    """Whether weapons with a bonus against armored units have it here."""
    radius: float = 0.375
    """From where ranges count: they go from edge to edge."""
    body: float = 0.375
    """Radius at which units push each other apart."""
    speed: float = 0.0
    """Cells per second; 0 cannot be moved, nor pushed."""
    damage: float = 0.0
    """Of one hit."""
    bonus: float = 0.0
    """More of it against armored units."""
    period: float = 1.0
    """Between two attacks, random delay aside."""
    reach: float = 0.0
    """How far the weapon carries."""
    scan: float = 5.0
    """How far an enemy looks for someone to attack."""
    windup: float = 0.0
    """From an attack to its hit, which is lost, and the attack free again, if the target leaves."""
    second_hit: float = 0.0
    """From an attack's first hit to its second, which nothing averts; 0 has only one."""
    backswing: float = 0.0
    """How long an enemy stands still after it attacked; orders cut that short for allies."""
    shield_regeneration: float = 0.0
    """Points per second, once `SHIELD_DELAY` is over."""
    health_regeneration: float = 0.0
    """Points per second, always."""
    cooldown_scale: float = 1.0
    """What the global state divides cooldowns by, in ticks (SMAC's `unit_max_cooldown`)."""


MARINE = UnitType(
    health=45.0,
    speed=2.25,
    damage=6.0,
    period=0.8608,
    reach=5.0,
    backswing=0.75,
    cooldown_scale=15.0,
)
ZEALOT = UnitType(
    health=100.0,
    shield=50.0,
    armor=1.0,
    radius=0.5,
    speed=2.25,
    damage=8.0,
    period=1.2,
    reach=0.1,
    second_hit=0.28,
    backswing=0.5,
    shield_regeneration=2.0,
    cooldown_scale=22.0,
)
STALKER = UnitType(
    health=80.0,
    shield=80.0,
    armor=1.0,
    armored=True,
    radius=0.625,
    body=0.625,
    speed=2.9531,
    damage=13.0,
    bonus=5.0,
    period=1.87,
    reach=6.0,
    scan=6.0,
    backswing=0.5,
    shield_regeneration=2.0,
    cooldown_scale=35.0,
)
SPINE_CRAWLER = UnitType(
    health=300.0,
    armor=2.0,
    armored=True,
    radius=0.875,
    body=0.875,
    damage=25.0,
    bonus=5.0,
    period=1.85,
    reach=7.0,
    scan=7.0,
    windup=0.3332,
    health_regeneration=0.2734,
)

UNIT_TYPES: dict[Balance, dict[str, UnitType]] = {
    "multi": {
        "marine": MARINE,
        "zealot": ZEALOT,
        "stalker": STALKER,
        "spine_crawler": SPINE_CRAWLER,
    },
    "liberty": {
        "marine": MARINE,
        "zealot": ZEALOT,
        "stalker": replace(STALKER, damage=10.0, bonus=4.0, period=1.44),
        "spine_crawler": replace(SPINE_CRAWLER, period=1.6),
    },
}
"""By balance and name: of multiplayer games, and of the campaign that SMAC's maps build on."""
