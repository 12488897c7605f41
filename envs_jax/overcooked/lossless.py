"""The whole kitchen as 26 numbers per cell: `lossless_state_encoding` of `overcooked_ai`.

Channels, with (0) for those that are always 0 because they concern tomatoes:

- 0, 1: place of the observer, of the other cook
- 2 to 5, 6 to 9: orientation (N S E W) of the observer, of the other cook
- 10, 11: pot, counter
- 12 to 14: dispenser of onions, tomatoes (0), dishes
- 15: serving window
- 16, 17: onions, tomatoes (0) in a pot that has not started to cook
- 18, 19: onions, tomatoes (0) in a soup
- 20, 21: steps until the soup is ready, 1 if it is ready
- 22 to 24: dish, onion, tomato (0), on a counter or in a hand
- 25: 1 in all cells if fewer than 40 steps are left

Cells are in order of x, then y: an observation is (width, height, 26), flattened.
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
    steps_until_ready,
)

CHANNELS = 26
URGENT_STEPS = 40
"""The last channel is 1 when fewer steps than this are left."""
FIXED = {ONIONS: 12, DISHES: 14, SERVING: 15}
IS_POT, IS_COUNTER, POT_ONIONS, SOUP_ONIONS, REMAINING, IS_READY, HAS_DISH, HAS_ONION, IS_URGENT = (
    *(10, 11, 16, 18, 20, 21, 22, 23, 25),
)
STANDING = NUM_CELL_STATES
"""First state of a floor cell on which a cook stands. The state of such a cell is
STANDING + item + 6 * (orientation + 4 * who), with who = 0 for the observer and 1 for the other."""
NUM_STATES = STANDING + 8 * NUM_ITEMS


def _channels() -> np.ndarray:
    """Return the channels of each cell state, (2 * states, 26).

    The second half of the rows is for time steps with few steps left.
    """
    channels = np.zeros((NUM_STATES, CHANNELS), np.int8)
    for state, channel in FIXED.items():
        channels[state, channel] = 1
    channels[COUNTER : COUNTER + NUM_ITEMS, IS_COUNTER] = 1
    for first in (COUNTER, *range(STANDING, NUM_STATES, NUM_ITEMS)):
        channels[first + ONION, HAS_ONION] = 1
        channels[first + DISH, HAS_DISH] = 1
        channels[first + SOUP + 1 : first + NUM_ITEMS, IS_READY] = 1
        channels[first + SOUP + 1 : first + NUM_ITEMS, SOUP_ONIONS] = 1, 2, 3
    for who in range(2):
        for orientation in range(4):
            first = STANDING + NUM_ITEMS * (4 * who + orientation)
            channels[first : first + NUM_ITEMS, who] = 1
            channels[first : first + NUM_ITEMS, 2 + 4 * who + orientation] = 1
    for state in range(POT, NUM_CELL_STATES):
        onions, cooked = read_pot(state)
        channels[state, IS_POT] = 1
        channels[state, POT_ONIONS if cooked == IDLE else SOUP_ONIONS] = onions
        channels[state, REMAINING] = steps_until_ready(cooked)
        channels[state, IS_READY] = cooked == READY
    urgent = channels.copy()
    urgent[:, IS_URGENT] = 1
    return np.concatenate([channels, urgent])


CHANNELS_OF_STATE = _channels()


def observe(
    kitchen: Kitchen,
    pose: Int[Array, "2"],
    held: Int[Array, "2"],
    grid: Int[Array, " cells"],
    urgent: Bool[Array, ""],
) -> Float[Array, "2 width_height_26"]:
    """Encode the observations of two cooks, in the order given, by one look-up per cell.

    Args:
        kitchen: The kitchen.
        pose: Pose of each cook.
        held: Item that each cook holds.
        grid: State of each cell.
        urgent: True if fewer than `URGENT_STEPS` are left.
    """
    order = np.arange(len(grid)).reshape(-1, kitchen.width).T.ravel()
    state = grid[order] + NUM_STATES * urgent
    for who, cooks in enumerate((np.s_[:], np.s_[::-1])):  # The observers, then the others.
        standing = STANDING + NUM_ITEMS * (4 * who + pose[cooks] % 4) + held[cooks]
        occupied = order == pose[cooks, None] // 4  # (2, cells)
        state = state + jnp.where(occupied, standing[:, None], 0)
    return jnp.asarray(CHANNELS_OF_STATE)[state].reshape(2, -1).astype(jnp.float32)
