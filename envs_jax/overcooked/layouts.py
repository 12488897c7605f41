"""Kitchens of Overcooked as text.

The five layouts of Carroll et al. (2019, Fig. 3) are copied from the files of `overcooked_ai`. Each
line is a row and each letter a cell: X counter, O onions, D dishes, P pot, S serving window, blank
floor. 1 and 2 are the floor cells on which players 0 and 1 start.
"""

import textwrap
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from envs_jax.choices import show, suggest
from envs_jax.overcooked.rules import COUNTER, DISHES, FLOOR, ONIONS, POT, SERVING

LONGEST_SIDE = 128
"""Most cells of a row or a column; coordinates are 8-bit."""
LAYOUTS = {
    "cramped_room": """
XXPXX
O  2O
X1  X
XDXSX
""",
    "asymmetric_advantages": """
XXXXXXXXX
O XSXOX S
X   P 1 X
X2  P   X
XXXDXDXXX
""",
    "coordination_ring": """
XXXPX
X 1 P
D2X X
O   X
XOSXX
""",
    "forced_coordination": """
XXXPX
O X1P
O2X X
D X X
XXXSX
""",
    "counter_circuit_o_1order": """
XXXPPXXX
X  2   X
D XXXX S
X  1   X
XXXOOXXX
""",
}
STATES = {
    **{" ": FLOOR, "1": FLOOR, "2": FLOOR, "X": COUNTER},
    **{"O": ONIONS, "D": DISHES, "P": POT, "S": SERVING},
}


class Kitchen(NamedTuple):
    """Cells and geometry of a layout.

    Cells are numbered row by row from the top left: cell = width * y + x. A pose is
    4 * cell + orientation, with orientations in the order north, south, east, west.
    """

    width: int
    """Number of columns."""
    grid: np.ndarray
    """State of every cell at the start, (cells,), in the codes of `rules`."""
    start: np.ndarray
    """Cell on which each player starts, (2,)."""
    front: np.ndarray
    """Cell that is faced, (poses,)."""
    moved: np.ndarray
    """Pose that each action leads to if nobody is in the way, (poses * 6,)."""

    @property
    def height(self) -> int:
        """Number of rows."""
        return len(self.grid) // self.width

    @property
    def pots(self) -> np.ndarray:
        """Cells that are pots, in ascending order."""
        return np.flatnonzero(self.grid == POT)

    def xy(self, cell: int | np.ndarray) -> np.ndarray:
        """Return the coordinates of a cell, (2,), or of cells, (2, cells): x right and y down."""
        return np.array([cell % self.width, cell // self.width])


@lru_cache
def read(layout: str) -> Kitchen:
    """Read a layout given by name or as text.

    Args:
        layout: Key of `LAYOUTS`, or the kitchen as lines of text. Blank lines around it and
            indentation common to all lines are ignored.

    Raises:
        ValueError: The name is unknown, or the kitchen is not valid.
    """
    if layout not in LAYOUTS and "\n" not in layout.strip():
        raise ValueError(f"layout {show(layout)} is unknown{suggest(layout, LAYOUTS)}")
    rows = textwrap.dedent(LAYOUTS.get(layout, layout)).strip("\n").split("\n")
    _check(rows)
    text = "".join(rows)
    width = len(rows[0])
    grid = np.array([STATES[letter] for letter in text], np.int32)
    cell = np.arange(len(grid), dtype=np.int32)[:, None]
    # The modulo keeps indices of border cells in range; nobody ever stands there.
    front = (cell + np.array([-width, width, 1, -1], np.int32)) % len(grid)
    moved = np.empty((len(grid), 4, 6), np.int32)
    moved[:] = (4 * cell + np.arange(4))[..., None]  # Staying and interacting keep the pose.
    moved[..., :4] = (4 * np.where(grid[front] == FLOOR, front, cell) + np.arange(4))[:, None]
    start = np.array([text.index("1"), text.index("2")], np.int32)
    return Kitchen(width=width, grid=grid, start=start, front=front.ravel(), moved=moved.ravel())


def _check(rows: list[str]) -> None:
    """Raise a `ValueError` unless two players can cook in this kitchen."""
    if max(len(rows), len(rows[0])) > LONGEST_SIDE:
        raise ValueError(
            f"layout: {len(rows)} x {len(rows[0])} cells; a side has at most {LONGEST_SIDE}"
        )
    for number, row in enumerate(rows, 1):
        if unknown := set(row) - set(STATES):
            raise ValueError(
                f"layout: unknown letter {min(unknown)!r} in row {number}; a cell is X counter, "
                "O onions, D dishes, P pot, S serving window, a blank for floor, 1 or 2 player"
            )
        if len(row) != len(rows[0]):
            raise ValueError(
                f"layout: row {number} has {len(row)} cells, row 1 has {len(rows[0])}; "
                "make all rows equally long"
            )
    text = "".join(rows)
    for player in "12":
        if text.count(player) != 1:
            raise ValueError(
                f"layout: {player!r} occurs {text.count(player)} times; write exactly one 1 and "
                "one 2 for the two players"
            )
    parts = {"P": "pot", "O": "onions", "D": "dishes", "S": "serving window"}
    for letter, part in parts.items():
        if letter not in text:
            raise ValueError(f"layout: no {part} on the map; write at least one {letter}")
    border = rows[0] + rows[-1] + "".join(row[0] + row[-1] for row in rows)
    if set(border) & set(" 12"):
        raise ValueError("layout: the border has a floor cell; close it, for example with X")
    _check_soups("".join(rows), len(rows[0]))


def _check_soups(text: str, width: int) -> None:
    """Raise a `ValueError` unless the players, alone or together, can serve a soup.

    Players pass things to each other over a counter that both can face, and over pots.
    """
    faced = [_reach(text, width, text.index(player)) for player in "12"]
    shared = any(text[cell] == "X" for cell in faced[0] & faced[1])

    def carriers(players: list[set[int]], cells: set[int]) -> list[set[int]]:
        """Return what is faced by each player that can hold a thing which `players` get there."""
        able = [player for player in players if player & cells]
        return faced if able and shared else able

    of = {letter: {c for c, x in enumerate(text) if x == letter} for letter in "PODS"}
    pots = set().union(*carriers(faced, of["O"])) & of["P"]
    with_soup = carriers(carriers(faced, of["D"]), pots)
    can_serve = any(player & of["S"] for player in with_soup)
    for can, task in ((pots, "bring onions to a pot"), (can_serve, "serve a soup")):
        if not can:
            raise ValueError(
                f"layout: the players cannot {task}; open a way, or give them a counter that both "
                "can face"
            )


def _reach(text: str, width: int, start: int) -> set[int]:
    """Return the cells that are no floor and that a player who starts at `start` can face."""
    seen, faced, waiting = {start}, set(), [start]
    while waiting:
        cell = waiting.pop()
        for front in (cell - width, cell + width, cell - 1, cell + 1):
            if text[front] not in " 12":
                faced.add(front)
            elif front not in seen:
                seen.add(front)
                waiting.append(front)
    return faced
