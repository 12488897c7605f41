"""What happens at counters, pots and windows of Overcooked, as tables over small integers.

The state of a cell is one number, and so is what a hand holds. The rules for using a cell are
written below in Python for one cell and one hand (`_use`), as `overcooked_ai` has them
(`resolve_interacts`), and looked up during play.
"""

from functools import lru_cache
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

StartCooking = Literal["interact", "auto"]

NOTHING, ONION, DISH, SOUP = 0, 1, 2, 2
"""Items, in a hand or on a counter; a soup of n = 1, 2 or 3 onions is SOUP + n."""
NUM_ITEMS = 6

CAPACITY = 3
"""Onions that a pot holds, and that a soup needs to be paid for."""
IDLE, READY = -1, 20
"""Steps that a pot has cooked: -1 if it has not begun, and no more than the 20 that it takes."""

FLOOR, ONIONS, DISHES, SERVING = range(4)
"""States of cells that never change."""
COUNTER = 4
"""State of an empty counter; COUNTER + item when something lies on it."""
POT = COUNTER + NUM_ITEMS
"""State of an empty pot; the others follow, see `pot_state`."""
COOKING = POT + CAPACITY + 1
NUM_CELL_STATES = COOKING + CAPACITY * (READY + 1)


def pot_state(onions: int, cooked: int) -> int:
    """State of a pot: idle by onions, then the rest by steps cooked and onions."""
    return POT + onions if cooked == IDLE else COOKING + CAPACITY * cooked + onions - 1


def read_pot(state: int) -> tuple[int, int]:
    """Onions and steps cooked, the inverse of `pot_state`."""
    if state < COOKING:
        return state - POT, IDLE
    return (state - COOKING) % CAPACITY + 1, (state - COOKING) // CAPACITY


def cook(grid: Int[Array, " cells"], start: StartCooking) -> Int[Array, " cells"]:
    """Let one step pass in all pots."""
    if start == "auto":
        grid = jnp.where(grid == pot_state(CAPACITY, IDLE), pot_state(CAPACITY, 0), grid)
    is_cooking = (grid >= COOKING) & (grid < pot_state(1, READY))
    return jnp.where(is_cooking, grid + CAPACITY, grid)


@lru_cache
def use_table(start: StartCooking) -> np.ndarray:
    """(cell states * items,), what using a cell leads to: cell << 4 | item << 1 | paid."""
    table = np.zeros((NUM_CELL_STATES, NUM_ITEMS), np.int32)
    for cell in range(NUM_CELL_STATES):
        for item in range(NUM_ITEMS):
            after, hand, paid = _use(cell, item, start)
            table[cell, item] = after << 4 | hand << 1 | paid
    return table.ravel()


def _use(cell: int, item: int, start: StartCooking) -> tuple[int, int, bool]:
    """State of the cell and what the hand holds after using the cell, and whether it pays."""
    unchanged = cell, item, False
    if cell in (ONIONS, DISHES) and item == NOTHING:
        return cell, ONION if cell == ONIONS else DISH, False
    if cell == SERVING and item > SOUP:
        return cell, NOTHING, item == SOUP + CAPACITY
    if COUNTER <= cell < POT:
        lying = cell - COUNTER
        put_or_take = (item == NOTHING) != (lying == NOTHING)
        return (COUNTER + item, lying, False) if put_or_take else unchanged
    if cell >= POT:
        onions, cooked = read_pot(cell)
        if item == ONION and cooked == IDLE and onions < CAPACITY:
            return pot_state(onions + 1, IDLE), NOTHING, False
        if item == DISH and cooked == READY:
            return POT, SOUP + onions, False
        if item == NOTHING and cooked == IDLE and onions > 0 and start == "interact":
            return pot_state(onions, 0), NOTHING, False
    return unchanged
