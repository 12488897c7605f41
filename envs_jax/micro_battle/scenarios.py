"""Scenarios of `micro_battle`: units, starting positions, walls, goals and time limits.

Positions are (x, y) in cells, with y upwards. Positions, walls, goals and time limits of 3m,
2s_vs_1sc and 2m_vs_1z are read from SMAC's own map archives (oxwhirl/smac, SMAC_Maps). 5m_vs_6m,
2s3z and 3s_vs_5z are examples that share only units and time limits with SMAC.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from envs_jax.choices import check_whole, show, suggest
from envs_jax.micro_battle.unit_types import UNIT_TYPES

Rectangle = tuple[int, int, int, int]
Point = tuple[float, float]


@dataclass(frozen=True)
class Spawn:
    """Unit and its starting position."""

    unit: str
    """Name of its type in `unit_types.UNIT_TYPES`."""
    x: float
    y: float


@dataclass(frozen=True)
class Scenario:
    """Units, map and time limit of a battle.

    The allies are the agents, in the given order. Enemies are numbered in the given order too.

    Raises:
        ValueError: A side has no units, a unit is unknown, there is no floor on the map, a unit
            starts in a wall or at the place of another, a goal is in a wall, there are more than
            two goals, or `size`, `max_steps` or `jitter` is out of range.
    """

    allies: tuple[Spawn, ...]
    """Units of the agents. An episode starts them within `jitter` of these positions."""
    enemies: tuple[Spawn, ...]
    """Units of the other side, likewise."""
    floor: tuple[Rectangle, ...]
    """Area in which units can walk: a union of rectangles (left, bottom, right, top)."""
    goals: tuple[Point, ...] = ()
    """Destination of the enemies, which attack whom they meet on the way. Without goals they stay.
    With one they walk there. With two they walk to a point of the line between them, drawn for each
    episode."""
    max_steps: int = 100
    """Time limit in environment steps of 0.5 s each."""
    size: tuple[int, int] = (32, 32)
    """Width and height of the map in cells. They scale positions in the global state."""
    jitter: float = 0.1
    """Largest distance in cells between the given position of a unit and its start in an episode.
    Starts are uniform over the disc of this radius, except that buildings have fixed places."""

    def __post_init__(self) -> None:
        check_whole("max_steps", self.max_steps)
        if len(self.size) != 2:
            raise ValueError(f"size must be width and height, got {show(self.size)}")
        for length in self.size:
            check_whole("size", length)
        if not (math.isfinite(self.jitter) and self.jitter >= 0):
            raise ValueError(f"jitter must be finite and at least 0, got {self.jitter}")
        if not self.floor or not all(self._is_on_map(rectangle) for rectangle in self.floor):
            raise ValueError(
                "floor must be rectangles (left, bottom, right, top) that are not empty, on a map "
                f"of size {self.size}; got {show(self.floor)}"
            )
        for side in ("allies", "enemies"):
            self._check_units(side)
        if len(self.goals) > 2:
            raise ValueError(f"goals must hold no, one or two points, got {len(self.goals)}")
        for goal in self.goals:
            if not is_floor(self.floor, *goal):
                raise ValueError(f"goals: {goal} is in a wall; move it onto the floor")

    def _is_on_map(self, rectangle: Rectangle) -> bool:
        left, bottom, right, top = rectangle
        width, height = self.size
        return 0 <= left < right <= width and 0 <= bottom < top <= height

    def _check_units(self, side: str) -> None:
        spawns = getattr(self, side)
        if not spawns:
            raise ValueError(f"{side} must have at least one unit, got none")
        for index, spawn in enumerate(spawns):
            where = f"{side}[{index}]"
            if spawn.unit not in UNIT_TYPES["multi"]:
                hint = suggest(spawn.unit, UNIT_TYPES["multi"])
                raise ValueError(f"{where}: unit {spawn.unit!r} is unknown{hint}")
            if side == "allies" and not UNIT_TYPES["multi"][spawn.unit].speed:
                raise ValueError(
                    f"{where}: a {spawn.unit} cannot move; choose a unit that can for an agent"
                )
            offsets = (-self.jitter, self.jitter)
            corners = [(spawn.x + dx, spawn.y + dy) for dx in offsets for dy in offsets]
            if not all(is_floor(self.floor, x, y) for x, y in corners):
                raise ValueError(
                    f"{where}: the {spawn.unit} at ({spawn.x}, {spawn.y}) starts in a wall, or "
                    f"less than {self.jitter} from one; move it onto the floor"
                )
            others = (*self.allies, *self.enemies)
            if sum((o.x, o.y) == (spawn.x, spawn.y) for o in others) > 1:
                raise ValueError(
                    f"{where}: another unit also starts at ({spawn.x}, {spawn.y}); move one of them"
                )


def is_floor(floor: Sequence[tuple[float, float, float, float]], x: Any, y: Any) -> Any:
    """Test whether points, given as numbers or as arrays of one shape, are in any rectangle."""
    inside = False
    for left, bottom, right, top in floor:
        inside = inside | (left <= x) & (x < right) & (bottom <= y) & (y < top)
    return inside


def line(unit: str, count: int, x: float, y: float, spacing: float = 0.8) -> tuple[Spawn, ...]:
    """Place `count` units one above the other, centered at (x, y) and `spacing` cells apart."""
    return tuple(
        Spawn(unit, x, round(y + spacing * (index - (count - 1) / 2), 3)) for index in range(count)
    )


BAND = ((0, 8, 32, 24),)
HOUSE = ((8, 8, 20, 20), (9, 20, 19, 21), (10, 21, 18, 22), (11, 22, 17, 23), (12, 23, 16, 24))
OCTAGON = ((6, 10, 26, 22), (7, 9, 25, 23), (8, 8, 24, 24), (9, 7, 23, 25), (10, 6, 22, 26))

SCENARIOS: dict[str, Scenario] = {
    "3m": Scenario(
        allies=line("marine", 3, 9.0, 16.0),
        enemies=line("marine", 3, 23.0, 16.0),
        floor=BAND,
        goals=((9.0, 16.0),),
        max_steps=60,
    ),
    "2s_vs_1sc": Scenario(
        allies=(Spawn("stalker", 11.1208, 10.338), Spawn("stalker", 16.976, 10.3662)),
        enemies=(Spawn("spine_crawler", 14.0, 20.0),),
        floor=HOUSE,
        max_steps=300,
    ),
    "2m_vs_1z": Scenario(
        allies=(Spawn("marine", 13.0, 12.0), Spawn("marine", 19.0, 12.0)),
        enemies=(Spawn("zealot", 16.0, 19.0),),
        floor=OCTAGON,
        goals=((13.0, 12.0), (19.0, 12.0)),
        max_steps=150,
    ),
    "5m_vs_6m": Scenario(
        allies=line("marine", 5, 9.0, 16.0),
        enemies=line("marine", 6, 23.0, 16.0),
        floor=BAND,
        goals=((9.0, 16.0),),
        max_steps=70,
    ),
    "2s3z": Scenario(
        allies=line("stalker", 2, 8.0, 16.0, 1.5) + line("zealot", 3, 9.5, 16.0),
        enemies=line("stalker", 2, 24.0, 16.0, 1.5) + line("zealot", 3, 22.5, 16.0),
        floor=BAND,
        goals=((9.0, 16.0),),
        max_steps=120,
    ),
    "3s_vs_5z": Scenario(
        allies=line("stalker", 3, 9.0, 16.0, 1.5),
        enemies=line("zealot", 5, 23.0, 16.0),
        floor=BAND,
        goals=((9.0, 16.0),),
        max_steps=250,
    ),
}
"""Scenarios by name."""
