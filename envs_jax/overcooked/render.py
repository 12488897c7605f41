"""Pictures of Overcooked, drawn with NumPy at twice the size and averaged for smooth edges."""

from functools import cache
from typing import Any

import numpy as np

from envs_jax.overcooked.layouts import Kitchen
from envs_jax.overcooked.rules import (
    CAPACITY,
    COUNTER,
    DISH,
    DISHES,
    FLOOR,
    IDLE,
    NOTHING,
    ONION,
    ONIONS,
    POT,
    READY,
    SERVING,
    SOUP,
    read_pot,
)

SIDE = 64
"""Pixels per cell of the picture."""
DETAIL = 2
"""Pixels drawn per pixel shown, along each axis."""
COOKS = ((58, 110, 196), (214, 84, 60))
"""Colors of agents 0 and 1."""
COLORS = {
    "floor": (243, 238, 226),
    "joint": (226, 218, 200),
    "counter": (176, 128, 82),
    "top": (201, 155, 106),
    "crate": (120, 82, 48),
    "onion": (238, 190, 62),
    "skin": (196, 138, 30),
    "plate": (250, 250, 250),
    "rim": (160, 168, 178),
    "stove": (70, 74, 84),
    "pot": (34, 36, 42),
    "metal": (128, 134, 146),
    "soup": (232, 148, 44),
    "thin": (240, 205, 130),
    "window": (112, 122, 128),
    "sign": (96, 190, 120),
    "empty": (52, 54, 60),
    "ready": (84, 196, 98),
    "ink": (36, 32, 30),
    "hat": (255, 255, 255),
}
FACING = ((0, -1), (0, 1), (1, 0), (-1, 0))


class _Canvas:
    """Image on which to paint shapes, in units of cells."""

    def __init__(self, image: np.ndarray) -> None:
        self.scale = SIDE * DETAIL
        self.image = image

    def box(self, x: float, y: float, half: tuple, color: str, round_by: float = 0.0) -> None:
        """Paint a rectangle around (x, y).

        Args:
            x: Center, in cells to the right.
            y: Center, in cells down.
            half: Half of its width and of its height.
            color: Key of `COLORS`.
            round_by: Radius of its corners.
        """
        part, dx, dy = self._around(x, y, half)
        outside_x = np.maximum(abs(dx) - half[0] + round_by, 0)
        outside_y = np.maximum(abs(dy) - half[1] + round_by, 0)
        part[np.hypot(outside_x, outside_y) <= round_by] = COLORS[color]

    def disc(self, x: float, y: float, radius: float, color: str | tuple) -> None:
        """Paint a disc around (x, y)."""
        part, dx, dy = self._around(x, y, (radius, radius))
        part[np.hypot(dx, dy) < radius] = COLORS[color] if isinstance(color, str) else color

    def _around(self, x: float, y: float, half: tuple) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the image within `half` of (x, y), and the distances of its columns and rows."""
        left, top = (max(int((c - h) * self.scale), 0) for c, h in zip((x, y), half))
        right, bottom = (int((c + h) * self.scale) + 1 for c, h in zip((x, y), half))
        part = self.image[top:bottom, left:right]
        rows, columns = np.ogrid[: part.shape[0], : part.shape[1]]
        dx, dy = (columns + left + 0.5) / self.scale - x, (rows + top + 0.5) / self.scale - y
        return part, dx, dy

    def item(self, x: float, y: float, item: int, size: float = 1.0) -> None:
        """Paint an item in a hand or on a counter."""
        if item == ONION:
            self.disc(x, y, 0.17 * size, "skin")
            self.disc(x, y, 0.14 * size, "onion")
            self.box(x, y - 0.17 * size, (0.025 * size, 0.06 * size), "skin")
        elif item >= DISH:
            self.disc(x, y, 0.22 * size, "rim")
            self.disc(x, y, 0.20 * size, "plate")
            self.disc(x, y, 0.14 * size, "rim")
            self.disc(x, y, 0.13 * size, "plate" if item == DISH else "soup")
            self.bits(x, y, item - SOUP, size)

    def bits(self, x: float, y: float, onions: int, size: float) -> None:
        """Paint the onions of a soup."""
        for angle in np.arange(onions) * 2 * np.pi / CAPACITY - np.pi / 2:
            place = x + 0.065 * size * np.cos(angle), y + 0.065 * size * np.sin(angle)
            self.disc(*place, 0.045 * size, "thin")


def draw(kitchen: Kitchen, state: Any) -> np.ndarray:
    """Draw an unbatched `OvercookedState` as a uint8 image (height, width, 3)."""
    cells = [_cell_picture(code) for code in np.asarray(state.grid).tolist()]
    rows = [np.hstack(cells[i : i + kitchen.width]) for i in range(0, len(cells), kitchen.width)]
    canvas = _Canvas(np.vstack(rows))
    for player, (pose, item) in enumerate(zip(np.asarray(state.pose), np.asarray(state.held))):
        x, y = kitchen.xy(int(pose) // 4) + 0.5
        color = COOKS[player ^ int(state.swapped)]
        _draw_cook(canvas, x, y, FACING[int(pose) % 4], int(item), color)
    # Sums over whole pictures are faster than `mean` over axes of two pixels.
    corners = [canvas.image[i::DETAIL, j::DETAIL] for i in range(DETAIL) for j in range(DETAIL)]
    return (np.sum(corners, axis=0) / len(corners)).round().astype(np.uint8)


@cache
def _cell_picture(code: int) -> np.ndarray:
    """Draw one cell alone. A kitchen has few states of cells, and an episode many pictures."""
    canvas = _Canvas(np.zeros((SIDE * DETAIL, SIDE * DETAIL, 3), np.float32))
    _draw_cell(canvas, 0.5, 0.5, code)
    return canvas.image


def _draw_cell(canvas: _Canvas, x: float, y: float, code: int) -> None:
    """Draw one cell around (x, y), without a cook that stands there."""
    if code == FLOOR:
        canvas.box(x, y, (0.5, 0.5), "joint")
        canvas.box(x, y, (0.485, 0.485), "floor")
        return
    canvas.box(x, y, (0.5, 0.5), "counter")
    canvas.box(x, y - 0.02, (0.47, 0.46), "top", 0.06)
    if code == ONIONS:
        canvas.box(x, y, (0.36, 0.32), "crate", 0.05)
        for dx, dy in ((-0.15, -0.08), (0.15, -0.08), (0, 0.1)):
            canvas.item(x + dx, y + dy, ONION, 0.85)
    elif code == DISHES:
        for lift in (0.09, 0.03, -0.03, -0.09):
            canvas.item(x, y + lift, DISH, 1.3)
    elif code == SERVING:
        canvas.box(x, y, (0.47, 0.47), "window", 0.06)
        canvas.disc(x, y + 0.04, 0.26, "sign")
        canvas.box(x, y + 0.22, (0.3, 0.14), "window")
        canvas.box(x, y + 0.12, (0.32, 0.035), "sign", 0.03)
        canvas.disc(x, y - 0.24, 0.05, "sign")
    elif code >= POT:
        _draw_pot(canvas, x, y, *read_pot(code))
    elif code > COUNTER:
        canvas.item(x, y, code - COUNTER, 1.3)


def _draw_pot(canvas: _Canvas, x: float, y: float, onions: int, cooked: int) -> None:
    """Draw a pot on its stove, with its onions or soup and a bar for the steps cooked."""
    canvas.box(x, y, (0.45, 0.45), "stove", 0.06)
    canvas.box(x, y - 0.07, (0.42, 0.05), "metal", 0.04)
    canvas.disc(x, y - 0.07, 0.34, "metal")
    canvas.disc(x, y - 0.07, 0.30, "pot")
    if cooked == IDLE:
        for angle in np.arange(onions) * 2 * np.pi / CAPACITY - np.pi / 2:
            canvas.item(x + 0.14 * np.cos(angle), y - 0.06 + 0.14 * np.sin(angle), ONION, 0.75)
        return
    canvas.disc(x, y - 0.07, 0.26, "soup")
    canvas.bits(x, y - 0.07, onions, 1.9)
    canvas.box(x, y + 0.36, (0.38, 0.06), "empty", 0.03)
    done = 0.36 * cooked / READY
    color = "ready" if cooked == READY else "onion"
    canvas.box(x - 0.36 + done, y + 0.36, (done, 0.04), color, min(0.02, done))


def _draw_cook(
    canvas: _Canvas, x: float, y: float, facing: tuple[int, int], item: int, color: tuple
) -> None:
    """Draw a cook from above: shoulders in its color, a white hat, hands and its item in front."""
    dx, dy = facing
    canvas.disc(x, y, 0.36, "ink")
    canvas.disc(x, y, 0.335, color)
    for side in (-1, 1):
        hand = x + 0.30 * dx - 0.17 * side * dy, y + 0.30 * dy + 0.17 * side * dx
        canvas.disc(*hand, 0.095, "ink")
        canvas.disc(*hand, 0.07, color)
    canvas.disc(x - 0.06 * dx, y - 0.06 * dy, 0.22, "rim")
    canvas.disc(x - 0.06 * dx, y - 0.06 * dy, 0.20, "hat")
    if item != NOTHING:
        canvas.item(x + 0.31 * dx, y + 0.31 * dy, item)
