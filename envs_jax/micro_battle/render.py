"""Pictures of `micro_battle`, drawn with NumPy at twice the size and averaged for smooth edges."""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from envs_jax.micro_battle.physics import NOBODY, Units
from envs_jax.micro_battle.scenarios import Scenario, is_floor
from envs_jax.micro_battle.unit_types import UNIT_TYPES

CELL = 28
"""Pixels per cell of the picture."""
SMOOTH = 2
"""Pixels drawn per pixel shown, along each axis."""
MARGIN = 1.0
"""Cells of wall shown around the floor."""
AROUND = 2.0
"""Cells shown around the units of an episode."""

FLOOR, LINE, WALL, EDGE = (238, 235, 226), (224, 220, 208), (66, 71, 84), (46, 50, 60)
INK, PAPER = (28, 30, 34), (255, 255, 255)
ALLIES = ((231, 150, 40), (60, 150, 92), (58, 104, 196), (150, 90, 180), (200, 170, 30))
"""Colors of the agents, in turn."""
ENEMY = (196, 58, 58)
SHOT, HOSTILE_SHOT = (30, 120, 220), (220, 60, 50)
HEALTH, SHIELD, LOST = (70, 180, 80), (80, 160, 235), (120, 120, 120)


Box = tuple[float, float, float, float]
"""Part of the map: left, bottom, right and top, in cells."""


def bounds(floor: tuple) -> Box:
    """Return the part of the map that the picture shows."""
    left, bottom = (min(r[side] for r in floor) - MARGIN for side in (0, 1))
    return left, bottom, max(r[2] for r in floor) + MARGIN, max(r[3] for r in floor) + MARGIN


def surround(scenario: Scenario, env_states: Sequence) -> Box:
    """Return the part of the map in which units live in any of the states, with a margin."""
    units = [env_state.units for env_state in env_states]
    x, y, health = (np.array([getattr(u, n) for u in units]) for n in ("x", "y", "health"))
    x, y = x[health > 0], y[health > 0]
    near = (x.min() - AROUND, y.min() - AROUND, x.max() + AROUND, y.max() + AROUND)
    whole = bounds(scenario.floor)
    low = [max(math.floor(a), b) for a, b in zip(near[:2], whole[:2])]
    high = [min(math.ceil(a), b) for a, b in zip(near[2:], whole[2:])]
    return (low[0], low[1], high[0], high[1])


class Canvas:
    """Image in the coordinates of the scenario, with y upwards."""

    def __init__(self, box: Box) -> None:
        left, bottom, right, top = box
        scale = CELL * SMOOTH
        rows, cols = round((top - bottom) * scale), round((right - left) * scale)
        self.y = (top - (np.arange(rows) + 0.5) / scale)[:, None]
        self.x = (left + (np.arange(cols) + 0.5) / scale)[None]
        self.pixels = np.full((rows, cols, 3), WALL, np.float32)

    def paint(self, inside: Callable, color: tuple, box: tuple, opacity: float = 1.0) -> None:
        """Paint the points with `inside(x, y)` in the box (left, bottom, right, top)."""
        cols = np.flatnonzero((self.x[0] >= box[0]) & (self.x[0] <= box[2]))
        rows = np.flatnonzero((self.y[:, 0] >= box[1]) & (self.y[:, 0] <= box[3]))
        if not len(cols) or not len(rows):
            return
        part = np.s_[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
        x, y = self.x[:, part[1]], self.y[part[0]]
        mask = np.broadcast_to(inside(x, y), self.pixels[part].shape[:2])
        old = self.pixels[part][mask]
        self.pixels[part][mask] = (1 - opacity) * old + opacity * np.array(color)

    def disc(self, x: float, y: float, radius: float, color: tuple, opacity: float = 1.0) -> None:
        """Paint a filled circle."""
        box = (x - radius, y - radius, x + radius, y + radius)
        self.paint(lambda u, v: np.hypot(u - x, v - y) <= radius, color, box, opacity)

    def polygon(self, x: float, y: float, radius: float, corners: int, turn: float, color: tuple):
        """Paint a filled regular polygon with a corner at angle `turn`."""
        normals = turn + np.pi / corners + 2 * np.pi * np.arange(corners) / corners
        inner = radius * np.cos(np.pi / corners)

        def inside(u, v):
            sides = [(u - x) * np.cos(a) + (v - y) * np.sin(a) <= inner for a in normals]
            return np.logical_and.reduce(np.broadcast_arrays(*sides))

        self.paint(inside, color, (x - radius, y - radius, x + radius, y + radius))

    def segment(self, start: tuple, end: tuple, width: float, color: tuple, opacity: float = 1.0):
        """Paint a straight line with round ends."""
        (x0, y0), (x1, y1) = start, end
        dx, dy = x1 - x0, y1 - y0
        square = max(dx * dx + dy * dy, 1e-9)

        def inside(u, v):
            along = np.clip(((u - x0) * dx + (v - y0) * dy) / square, 0, 1)
            return np.hypot(u - x0 - along * dx, v - y0 - along * dy) <= width / 2

        xs, ys = sorted((x0, x1)), sorted((y0, y1))
        box = (xs[0] - width, ys[0] - width, xs[1] + width, ys[1] + width)
        self.paint(inside, color, box, opacity)

    def rectangle(self, left, bottom, right, top, color: tuple) -> None:
        """Paint a filled rectangle."""
        self.paint(lambda u, v: np.True_, color, (left, bottom, right, top))

    def image(self) -> np.ndarray:
        """Return the picture at its final size, uint8 (height, width, 3)."""
        rows, cols = (size // SMOOTH for size in self.pixels.shape[:2])
        blocks = self.pixels[: rows * SMOOTH, : cols * SMOOTH]
        mean = blocks.reshape(rows, SMOOTH, cols, SMOOTH, 3).mean((1, 3))
        return np.round(mean).astype(np.uint8)


def draw(scenario: Scenario, env_state: Any, box: Box | None = None) -> np.ndarray:
    """Draw the map, the living units with health and shields, and the shots of the last step.

    Each agent has its own color, enemies are red. Marines are discs, zealots triangles with blades,
    stalkers squares on legs, and spine crawlers octagons. A notch points to the target of a unit.
    Shots of agents are blue lines, those of enemies red ones. Dead units leave a cross.

    Args:
        scenario: The scenario.
        env_state: Unbatched `MicroBattleState`.
        box: Part of the map to draw; None draws all of it.

    Returns:
        Image, uint8 (height, width, 3).
    """
    units = Units(*map(np.asarray, env_state.units))  # pyrefly: ignore
    box = bounds(scenario.floor) if box is None else box
    canvas = Canvas(box)
    canvas.pixels = _draw_floor(scenario, box).copy()
    spawns = (*scenario.allies, *scenario.enemies)
    num_allies = len(scenario.allies)
    alive = units.health > 0
    living = [index for index in range(len(spawns)) if alive[index]]
    for index in np.flatnonzero(~alive):
        _draw_cross(canvas, float(units.x[index]), float(units.y[index]))
    for index in living:
        _draw_unit(canvas, spawns[index].unit, units, index, num_allies)
    for index, target in enumerate(units.target):
        if target != NOBODY and -8 <= units.begun[index] < 0:
            color = SHOT if index < num_allies else HOSTILE_SHOT
            _draw_shot(canvas, units, index, target, color)
    for index in living:
        _draw_bars(canvas, spawns[index].unit, units, index)
    return canvas.image()


@lru_cache(maxsize=4)
def _draw_floor(scenario: Scenario, box: Box) -> np.ndarray:
    """Return the pixels of the empty map."""
    canvas = Canvas(box)
    everywhere = (-np.inf, -np.inf, np.inf, np.inf)
    rim = 0.12
    grown = tuple((a - rim, b - rim, c + rim, d + rim) for a, b, c, d in scenario.floor)
    canvas.paint(lambda x, y: is_floor(grown, x, y), EDGE, everywhere)
    canvas.paint(lambda x, y: is_floor(scenario.floor, x, y), FLOOR, everywhere)
    line = 1 / CELL

    def grid(x, y):
        return is_floor(scenario.floor, x, y) & ((x % 2 < line) | (y % 2 < line))

    canvas.paint(grid, LINE, everywhere)
    return canvas.pixels


def _draw_unit(canvas: Canvas, name: str, units: Units, index: int, num_allies: int) -> None:
    x, y = float(units.x[index]), float(units.y[index])
    is_ally = index < num_allies
    color = ALLIES[index % len(ALLIES)] if is_ally else ENEMY
    radius = UNIT_TYPES["multi"][name].body
    target = units.target[index]
    turn = 0.0 if is_ally else np.pi
    if target != NOBODY:
        turn = float(np.arctan2(units.y[target] - y, units.x[target] - x))
    canvas.disc(x + 0.06, y - 0.08, radius + 0.08, INK, 0.18)
    if name == "stalker":
        for leg in turn + np.pi / 4 + np.pi / 2 * np.arange(4):
            foot = (x + 1.2 * radius * np.cos(leg), y + 1.2 * radius * np.sin(leg))
            canvas.segment((x, y), foot, 0.14, INK)
        shape = (4, 0.92)
    elif name == "zealot":
        shape = (3, 1.35)
        for side in (-0.7, 0.7):
            blade = turn + side
            tip = (x + 1.5 * radius * np.cos(blade / 2 + turn / 2), 0)
            tip = (tip[0], y + 1.5 * radius * np.sin(blade / 2 + turn / 2))
            start = (x + radius * np.cos(blade), y + radius * np.sin(blade))
            canvas.segment(start, tip, 0.1, SHIELD)
    elif name == "spine_crawler":
        canvas.polygon(x, y, radius * 1.15, 8, turn, INK)
        shape = (8, 1.0)
    else:
        shape = (0, 1.0)
    if shape[0]:
        canvas.polygon(x, y, radius * shape[1] + 0.07, shape[0], turn, INK)
        canvas.polygon(x, y, radius * shape[1], shape[0], turn, color)
    else:
        canvas.disc(x, y, radius + 0.05, INK)
        canvas.disc(x, y, radius, color)
    nose = (x + 0.85 * radius * np.cos(turn), y + 0.85 * radius * np.sin(turn))
    canvas.segment((x, y), nose, 0.13, PAPER)


def _draw_shot(canvas: Canvas, units: Units, index: int, target: int, color: tuple) -> None:
    start = float(units.x[index]), float(units.y[index])
    x, y = float(units.x[target]), float(units.y[target])
    canvas.segment(start, (x, y), 0.14, color, 0.35)
    canvas.segment(start, (x, y), 0.06, color)
    canvas.disc(x, y, 0.16, PAPER, 0.9)
    canvas.disc(x, y, 0.1, color)


def _draw_bars(canvas: Canvas, name: str, units: Units, index: int) -> None:
    kind = UNIT_TYPES["multi"][name]
    x, half = float(units.x[index]), 0.8 * max(kind.body, 0.45)
    bottom = float(units.y[index]) + kind.body * 0.8
    rows = [(units.health[index] / kind.health, HEALTH)]
    if kind.shield:
        rows.append((units.shield[index] / kind.shield, SHIELD))
    height = 0.11
    edge = 0.035
    canvas.rectangle(
        x - half - edge, bottom - edge, x + half + edge, bottom + len(rows) * height + edge, INK
    )
    for row, (share, color) in enumerate(rows):
        low = bottom + row * height
        right = x - half + 2 * half * float(np.clip(share, 0, 1))
        canvas.rectangle(x - half, low, x + half, low + height - 0.015, LOST)
        canvas.rectangle(x - half, low, right, low + height - 0.015, color)


def _draw_cross(canvas: Canvas, x: float, y: float) -> None:
    for slope in (-1, 1):
        arm = 0.3
        canvas.segment((x - arm, y - slope * arm), (x + arm, y + slope * arm), 0.12, LOST, 0.8)
