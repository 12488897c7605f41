"""The hand-made features of Overcooked: `featurize_state` of `overcooked_ai`, 96 numbers a cook.

What a cook sees of the map is fixed by its pose (where it stands and where it turns), so it is
looked up; what the pots hold is filled in. As in the original with its default planner, objects
on counters and the time are not seen.

Of one cook (46): orientation (4: N S E W); held (4: onion, soup, dish, tomato); dx, dy to the
closest onions, tomatoes (0), dishes and soup (0); onions and tomatoes (0) in a held soup; dx, dy to
the closest serving window and empty counter (0); of each of the two closest pots whether it exists,
is empty, full, cooking, ready, its onions and tomatoes (0), the steps until it is ready, and dx, dy
(10); whether there is no floor at N S E W (4). An observation (96) is one's own 46, the other's 46,
dx, dy to the other, and one's own x, y. What is held is (0, 0) away, as is what cannot be reached.
"""

from collections import deque
from functools import lru_cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from envs_jax.overcooked.layouts import Kitchen, read
from envs_jax.overcooked.rules import (
    CAPACITY,
    DISH,
    DISHES,
    FLOOR,
    IDLE,
    NUM_CELL_STATES,
    NUM_ITEMS,
    ONION,
    ONIONS,
    POT,
    READY,
    SERVING,
    SOUP,
    read_pot,
)

COOK_FEATURES = 46
OBS_DIM = 2 * COOK_FEATURES + 4
HELD, TO_ONIONS, TO_DISHES, SOUP_ONIONS, TO_SERVING, FIRST_POT, WALLS = 4, 8, 12, 16, 18, 22, 42
"""Where among the 46 features these begin."""
POTS_SEEN, POT_FEATURES, TO_POT = 2, 10, 8
NUM_POT_STATES = NUM_CELL_STATES - POT
HELD_ORDER = {ONION: 0, SOUP + 1: 1, SOUP + 2: 1, SOUP + 3: 1, DISH: 2}
OWN, OTHER, TO_OTHER, XY = slice(0, 46), slice(46, 92), slice(92, 94), slice(94, 96)


class Tables(NamedTuple):
    """Rows of 96 whose sum is an observation."""

    cook_row: np.ndarray
    """(poses * items,), the row of a cook; 0, zeros, for poses off the floor."""
    own: np.ndarray
    """(rows, 96), what one's own pose and hand tell."""
    other: np.ndarray
    """(rows, 96), what those of the other tell."""
    pot_row: np.ndarray
    """(pots, poses * pot states), the row of a pot; 0, zeros, for a pot that is not seen."""
    own_pot: np.ndarray
    """(rows, 96), what the pots close to oneself tell."""
    other_pot: np.ndarray
    """(rows, 96), what those close to the other tell."""


@lru_cache
def tables(layout: str) -> Tables:
    """Write down every summand of the observations in a kitchen."""
    kitchen = read(layout)
    floor = np.flatnonzero(kitchen.grid == FLOOR).tolist()
    poses = [4 * cell + turn for cell in floor for turn in range(4)]
    cook_row = np.zeros((4 * len(kitchen.grid), NUM_ITEMS), np.int32)
    own, other = np.zeros((2, 1 + len(poses) * NUM_ITEMS, OBS_DIM), np.int8)
    pot_row = np.zeros((len(kitchen.pots), 4 * len(kitchen.grid), NUM_POT_STATES), np.int32)
    own_pot, other_pot = np.zeros((2, 1 + POTS_SEEN * NUM_POT_STATES, OBS_DIM), np.int8)
    for number, pose in enumerate(poses):
        rows = 1 + number * NUM_ITEMS + np.arange(NUM_ITEMS)
        cook_row[pose] = rows
        features, pots = _see(kitchen, pose)
        own[rows, OWN] = other[rows, OTHER] = features
        own[rows, XY] = other[rows, TO_OTHER] = kitchen.xy(pose // 4)
        own[rows, TO_OTHER] = -kitchen.xy(pose // 4)
        for place, pot in enumerate(pots):
            pot_row[pot, pose] = 1 + place * NUM_POT_STATES + np.arange(NUM_POT_STATES)
    for place in range(POTS_SEEN):
        rows = slice(1 + place * NUM_POT_STATES, 1 + (place + 1) * NUM_POT_STATES)
        begin = FIRST_POT + place * POT_FEATURES
        columns = np.arange(begin, begin + POT_FEATURES)
        own_pot[rows, columns] = other_pot[rows, COOK_FEATURES + columns] = _pot_features()
    pot_row = pot_row.reshape(len(kitchen.pots), -1)
    return Tables(cook_row.ravel(), own, other, pot_row, own_pot, other_pot)


def _see(kitchen: Kitchen, pose: int) -> tuple[np.ndarray, list[int]]:
    """From one pose: features (items, 46), without what pots hold, and the pots seen, in order."""
    cell, orientation = divmod(pose, 4)
    features = np.zeros((NUM_ITEMS, COOK_FEATURES), np.int8)
    features[:, orientation] = 1
    distance = _distances(kitchen, pose)
    for begin, kind in ((TO_ONIONS, ONIONS), (TO_DISHES, DISHES), (TO_SERVING, SERVING)):
        for target in _closest(kitchen, kind, distance)[:1]:
            features[:, begin : begin + 2] = kitchen.xy(target) - kitchen.xy(cell)
    pots = _closest(kitchen, POT, distance)[:POTS_SEEN]
    for place, target in enumerate(pots):
        begin = FIRST_POT + place * POT_FEATURES
        features[:, begin] = 1
        features[:, begin + TO_POT : begin + TO_POT + 2] = kitchen.xy(target) - kitchen.xy(cell)
    features[:, WALLS:] = kitchen.grid[kitchen.front[4 * cell : 4 * cell + 4]] != FLOOR
    for item, place in HELD_ORDER.items():
        features[item, HELD + place] = 1
        features[item, SOUP_ONIONS] = max(item - SOUP, 0)
    features[ONION, TO_ONIONS : TO_ONIONS + 2] = 0
    features[DISH, TO_DISHES : TO_DISHES + 2] = 0
    return features, [int(np.searchsorted(kitchen.pots, target)) for target in pots]


def _pot_features() -> np.ndarray:
    """(pot states, 10), what a pot's state tells of it; zeros for what its place does."""
    features = np.zeros((NUM_POT_STATES, POT_FEATURES), np.int8)
    for state in range(NUM_POT_STATES):
        onions, cooked = read_pot(POT + state)
        is_cooking = IDLE < cooked < READY
        is_full = onions == CAPACITY or cooked != IDLE
        remaining = READY - cooked if is_cooking else 0
        flags = (onions == 0, is_full, is_cooking, cooked == READY)
        features[state, 1:TO_POT] = (*flags, onions, 0, remaining)
    return features


def _distances(kitchen: Kitchen, start: int) -> dict[int, int]:
    """Steps from a pose until a cell is faced, for every cell that can be; breadth first."""
    faced, seen, queue = {}, {start}, deque([(start, 0)])
    while queue:
        pose, distance = queue.popleft()
        faced.setdefault(int(kitchen.front[pose]), distance)
        for after in kitchen.moved[6 * pose : 6 * pose + 4].tolist():
            if after not in seen:
                seen.add(after)
                queue.append((after, distance + 1))
    return faced


def _closest(kitchen: Kitchen, kind: int, distance: dict[int, int]) -> list[int]:
    """The cells of a kind that can be reached, closest first; in order of cells among equals."""
    cells = [cell for cell in np.flatnonzero(kitchen.grid == kind).tolist() if cell in distance]
    return sorted(cells, key=distance.__getitem__)


def observe(
    layout: str,
    pose: Int[Array, "2"],
    held: Int[Array, "2"],
    grid: Int[Array, " cells"],
) -> Float[Array, "2 96"]:
    """The observations of two cooks, in the order given.

    Sums of rows of tables make one vectorized loop on a CPU, and a row number that is itself looked
    up is computed once, not for each of the 96: concatenated from its parts, an observation took
    five times as long.
    """
    table = tables(layout)
    row = jnp.asarray(table.cook_row)[NUM_ITEMS * pose + held]
    obs = jnp.asarray(table.own)[row] + jnp.asarray(table.other)[row[::-1]]
    for pot, cell in enumerate(read(layout).pots):
        state = grid[cell] - POT
        row = jnp.asarray(table.pot_row[pot])[NUM_POT_STATES * pose + state]
        obs += jnp.asarray(table.own_pot)[row] + jnp.asarray(table.other_pot)[row[::-1]]
    return obs.astype(jnp.float32)
