"""Hand-made features of Overcooked: `featurize_state` of `overcooked_ai`, 96 numbers per cook.

The pose of a cook (cell and orientation) determines all that it sees of the map, so these features
are looked up, and the contents of the pots are added. As in the original with its default planner,
objects on counters and the time are not observed.

Each cook has 46 features. Those marked (0) are always 0: there are no tomatoes, and the default
planner ignores counters.

- orientation (4: N S E W)
- held item (4: onion, soup, dish, tomato)
- dx, dy to the closest onions, tomatoes (0), dishes and soup (0)
- onions and tomatoes (0) in a held soup
- dx, dy to the closest serving window and empty counter (0)
- for each of the two closest pots (10): exists, is empty, is full, is cooking, is ready, its onions
  and tomatoes (0), steps until it is ready, dx, dy
- for each of N S E W, 1 if there is no floor (4)

An observation (96) is the observer's own 46 features, those of the other cook, dx, dy to the other
cook, and the observer's x, y. dx, dy are (0, 0) to a kind of item that is held and to anything that
cannot be reached.
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
    NUM_ITEMS,
    NUM_POT_STATES,
    ONION,
    ONIONS,
    POT,
    READY,
    SERVING,
    SOUP,
    read_pot,
    steps_until_ready,
)

COOK_FEATURES = 46
OBS_DIM = 2 * COOK_FEATURES + 4
HELD, TO_ONIONS, TO_DISHES, SOUP_ONIONS, TO_SERVING, FIRST_POT, WALLS = 4, 8, 12, 16, 18, 22, 42
"""First index of these groups among the 46 features."""
POTS_SEEN, POT_FEATURES, TO_POT = 2, 10, 8
HELD_ORDER = {ONION: 0, SOUP + 1: 1, SOUP + 2: 1, SOUP + 3: 1, DISH: 2}
OWN, OTHER, TO_OTHER, XY = slice(0, 46), slice(46, 92), slice(92, 94), slice(94, 96)


class Tables(NamedTuple):
    """Rows of 96 numbers that sum to an observation, and the indices to find them."""

    cook_row: np.ndarray
    """Row for each pose and item, (poses * items,). Poses off the floor have row 0, all zeros."""
    own: np.ndarray
    """Features that follow from the observer's pose and item, (rows, 96)."""
    other: np.ndarray
    """Features that follow from the other cook's pose and item, (rows, 96)."""
    pot_row: np.ndarray
    """Row for a pot, (pots, poses * pot states). Pots not observed have row 0, all zeros."""
    own_pot: np.ndarray
    """Features of a pot close to the observer, (rows, 96)."""
    other_pot: np.ndarray
    """Features of a pot close to the other cook, (rows, 96)."""


@lru_cache
def tables(layout: str) -> Tables:
    """Compute every summand of the observations in a kitchen."""
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
        features, pots = _features_of_pose(kitchen, pose)
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
    return Tables(
        cook_row=cook_row.ravel(),
        own=own,
        other=other,
        pot_row=pot_row,
        own_pot=own_pot,
        other_pot=other_pot,
    )


def _features_of_pose(kitchen: Kitchen, pose: int) -> tuple[np.ndarray, list[int]]:
    """Compute the features of one pose.

    Returns:
        Features for each held item, (items, 46), without contents of pots, and the indices of the
        observed pots, closest first.
    """
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
    """Return the features of a pot by its state, (pot states, 10), with zeros for dx and dy."""
    features = np.zeros((NUM_POT_STATES, POT_FEATURES), np.int8)
    for state in range(NUM_POT_STATES):
        onions, cooked = read_pot(POT + state)
        remaining = steps_until_ready(cooked)
        is_full = onions == CAPACITY or cooked != IDLE
        flags = (onions == 0, is_full, remaining > 0, cooked == READY)
        features[state, 1:TO_POT] = (*flags, onions, 0, remaining)
    return features


def _distances(kitchen: Kitchen, start: int) -> dict[int, int]:
    """Search breadth first for the steps from a pose until each reachable cell is faced."""
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
    """Return the reachable cells of a kind, closest first. Ties are in the order of cells."""
    cells = [cell for cell in np.flatnonzero(kitchen.grid == kind).tolist() if cell in distance]
    return sorted(cells, key=distance.__getitem__)


def observe(
    layout: str,
    pose: Int[Array, "2"],
    held: Int[Array, "2"],
    grid: Int[Array, " cells"],
) -> Float[Array, "2 96"]:
    """Encode the observations of two cooks, in the order given.

    The encoding is a sum of table rows for speed. On a CPU the sum is one vectorized loop, and the
    index of a row is computed once instead of for each of the 96 numbers. Concatenating the parts
    of an observation took five times as long.

    Args:
        layout: Name or text of the kitchen.
        pose: Pose of each cook.
        held: Item that each cook holds.
        grid: State of each cell.
    """
    table = tables(layout)
    row = jnp.asarray(table.cook_row)[NUM_ITEMS * pose + held]
    obs = jnp.asarray(table.own)[row] + jnp.asarray(table.other)[row[::-1]]
    for pot, cell in enumerate(read(layout).pots):
        state = grid[cell] - POT
        row = jnp.asarray(table.pot_row[pot])[NUM_POT_STATES * pose + state]
        obs += jnp.asarray(table.own_pot)[row] + jnp.asarray(table.other_pot)[row[::-1]]
    return obs.astype(jnp.float32)
