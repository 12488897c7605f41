"""Unit types of `micro_battle`: health, movement and weapons.

The numbers come from StarCraft II's own data files (SC2Mapster/SC2GameData at 4.6.2 and 4.10, which
agree), in cells and in seconds of the game at "normal" speed. Most published tables give seconds at
"faster" speed, which are 1.4 times as long. Do not mix the two.
"""

from dataclasses import dataclass, replace
from typing import Literal

Balance = Literal["multi", "liberty"]

TICKS_PER_SECOND = 16
"""Ticks of the simulation (game loops) in a second at normal speed."""
SHIELD_DELAY = 10.0
"""Seconds without damage after which shields regenerate."""
EARLIEST, LATEST = -0.0625, 0.125
"""Bounds in seconds of the random delay that every shot adds to the period of its weapon."""


@dataclass(frozen=True)
class UnitType:
    """Unit type, with distances in cells and times in seconds."""

    health: float
    shield: float = 0.0
    armor: float = 0.0
    """Subtracted from every hit on health, not from hits on shields."""
    armored: bool = False
    """If True, weapons with a bonus against armored units apply it to this unit."""
    radius: float = 0.375
    """Radius for ranges, which are measured from edge to edge."""
    body: float = 0.375
    """Radius at which units push each other apart."""
    speed: float = 0.0
    """Cells per second. A unit of speed 0 cannot be pushed either."""
    damage: float = 0.0
    """Damage of one hit."""
    bonus: float = 0.0
    """Additional damage against armored units."""
    period: float = 1.0
    """Time between two attacks, without the random delay."""
    reach: float = 0.0
    """Range of the weapon."""
    scan: float = 5.0
    """Range in which an enemy looks for a target."""
    windup: float = 0.0
    """Time from the start of an attack to its hit. If the target leaves the range before the hit,
    the hit is lost and the unit can attack again at once."""
    second_hit: float = 0.0
    """Time from the first hit of an attack to a second, which always lands; 0 for a single hit."""
    backswing: float = 0.0
    """Time for which an enemy stands still after an attack. Allies do not, because their orders
    interrupt it."""
    shield_regeneration: float = 0.0
    """Points per second, after `SHIELD_DELAY`."""
    health_regeneration: float = 0.0
    """Points per second, always."""
    cooldown_scale: float = 1.0
    """Ticks by which the global state divides cooldowns (SMAC's `unit_max_cooldown`)."""


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
"""Unit types by balance and name: `multi` is that of multiplayer games, `liberty` that of the
campaign on which SMAC's maps build."""
