"""The whole kitchen as 26 numbers a cell: `lossless_state_encoding` of `overcooked_ai`.

Channels: own place; other's place; own orientation (4: N S E W); other's orientation (4); pot;
counter; onions to take; tomatoes to take (0); dishes to take; serving window; onions and tomatoes
(0) in a pot that has not begun to cook; onions and tomatoes (0) in a soup, in steps until it is
ready; whether it is; dish; onion; tomato (0), lying or in a hand; and, in all cells, whether fewer
than 40 steps are left. Cells are in order of x, then y: (width, height, 26), flat.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs_jax.overcooked.layouts import Kitchen
from envs_jax.overcooked.rules import (
    COUNTER,
    DISH,
    DISHES,
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

CHANNELS = 26
URGENT_STEPS = 40
"""The last channel turns on when fewer steps than this are left."""
FIXED = {ONIONS: 12, DISHES: 14, SERVING: 15}
IS_POT, IS_COUNTER, POT_ONIONS, SOUP_ONIONS, REMAINING, IS_READY, HAS_DISH, HAS_ONION, IS_URGENT = (
    *(10, 11, 16, 18, 20, 21, 22, 23, 25),
)
STANDING = NUM_CELL_STATES
"""State of a cell of floor on which someone stands, + items * (orientation, + 4 for the other)."""
NUM_STATES = STANDING + 8 * NUM_ITEMS


def _look() -> np.ndarray:
    """(2 * states, 26), what each state of a cell looks like; once more for when time is short."""
    look = np.zeros((NUM_STATES, CHANNELS), np.int8)
    for state, channel in FIXED.items():
        look[state, channel] = 1
    look[COUNTER : COUNTER + NUM_ITEMS, IS_COUNTER] = 1
    for first in (COUNTER, *range(STANDING, NUM_STATES, NUM_ITEMS)):
        look[first + ONION, HAS_ONION] = 1
        look[first + DISH, HAS_DISH] = 1
        look[first + SOUP + 1 : first + NUM_ITEMS, IS_READY] = 1
        look[first + SOUP + 1 : first + NUM_ITEMS, SOUP_ONIONS] = 1, 2, 3
    for who in range(2):
        for orientation in range(4):
            first = STANDING + NUM_ITEMS * (4 * who + orientation)
            look[first : first + NUM_ITEMS, who] = 1
            look[first : first + NUM_ITEMS, 2 + 4 * who + orientation] = 1
    for state in range(POT, NUM_CELL_STATES):
        onions, cooked = read_pot(state)
        look[state, IS_POT] = 1
        look[state, POT_ONIONS if cooked == IDLE else SOUP_ONIONS] = onions
        look[state, REMAINING] = 0 if cooked == IDLE else READY - cooked
        look[state, IS_READY] = cooked == READY
    urgent = look.copy()
    urgent[:, IS_URGENT] = 1
    return np.concatenate([look, urgent])


LOOK = _look()


def observe(
    kitchen: Kitchen,
    pose: Int[Array, "2"],
    held: Int[Array, "2"],
    grid: Int[Array, " cells"],
    urgent: Bool[Array, ""],
) -> Float[Array, "2 width_height_26"]:
    """The observations of two cooks, in the order given: every cell is looked up whole."""
    order = np.arange(len(grid)).reshape(-1, kitchen.width).T.ravel()
    state = grid[order] + NUM_STATES * urgent
    for who, view in enumerate((slice(None), slice(None, None, -1))):
        standing = STANDING + NUM_ITEMS * (4 * who + pose[view] % 4) + held[view]
        state = state + jnp.where(
            order == pose[view, None] // 4, standing[:, None], 0
        )  # (2, cells)
    return jnp.asarray(LOOK)[state].reshape(2, -1).astype(jnp.float32)
