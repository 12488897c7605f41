"""Rules of Overcooked for counters, pots, dispensers and windows, as tables over small integers.

The state of a cell is one integer, and so is the item in a hand. `_use` states the rules for one
cell and one hand in Python, following `resolve_interacts` of `overcooked_ai`. During play they are
looked up in a table.
"""

from functools import lru_cache
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

StartCooking = Literal["interact", "auto"]

NOTHING, ONION, DISH, SOUP = 0, 1, 2, 2
"""Items in a hand or on a counter. A soup of n = 1, 2 or 3 onions is SOUP + n."""
NUM_ITEMS = 6

CAPACITY = 3
"""Onions that fill a pot, and that a soup needs to earn the reward."""
IDLE, READY = -1, 20
"""Steps that a pot has cooked: -1 before it starts, and 20 from when the soup is ready."""

FLOOR, ONIONS, DISHES, SERVING = range(4)
"""States of cells that never change."""
COUNTER = 4
"""State of an empty counter. A counter with an item on it is COUNTER + item."""
POT = COUNTER + NUM_ITEMS
"""State of an empty pot. `pot_state` numbers the other states of a pot."""
COOKING = POT + CAPACITY + 1
NUM_CELL_STATES = COOKING + CAPACITY * (READY + 1)
NUM_POT_STATES = NUM_CELL_STATES - POT


def pot_state(onions: int, cooked: int) -> int:
    """Return the state of a pot: idle pots in order of onions, then others by steps and onions."""
    return POT + onions if cooked == IDLE else COOKING + CAPACITY * cooked + onions - 1


def read_pot(state: int) -> tuple[int, int]:
    """Return the onions in a pot and the steps cooked, the inverse of `pot_state`."""
    if state < COOKING:
        return state - POT, IDLE
    return (state - COOKING) % CAPACITY + 1, (state - COOKING) // CAPACITY


def steps_until_ready(cooked: int) -> int:
    """Return how long a pot still cooks: 0 before it starts and when the soup is ready."""
    return 0 if cooked == IDLE else READY - cooked


def cook(grid: Int[Array, " cells"], start: StartCooking) -> Int[Array, " cells"]:
    """Advance all pots by one step."""
    if start == "auto":
        grid = jnp.where(grid == pot_state(CAPACITY, IDLE), pot_state(CAPACITY, 0), grid)
    is_cooking = (grid >= COOKING) & (grid < pot_state(1, READY))
    return jnp.where(is_cooking, grid + CAPACITY, grid)


@lru_cache
def use_table(start: StartCooking) -> np.ndarray:
    """Tabulate `_use`: cell << 4 | item << 1 | rewarded, (cell states * items,)."""
    table = np.zeros((NUM_CELL_STATES, NUM_ITEMS), np.int32)
    for cell in range(NUM_CELL_STATES):
        for item in range(NUM_ITEMS):
            after, held, rewarded = _use(cell, item, start)
            table[cell, item] = after << 4 | held << 1 | rewarded
    return table.ravel()


def count_uses(
    cell_before: Int[Array, " players"],
    cell_after: Int[Array, " players"],
    item_before: Int[Array, " players"],
    item_after: Int[Array, " players"],
) -> dict[str, Bool[Array, " players"]]:
    """Tell what each player did with the cell that it faces, given that it interacts.

    Args:
        cell_before: State of the cell before the step.
        cell_after: State of the cell after the step.
        item_before: Item in the hand before the step.
        item_after: Item in the hand after the step.
    """
    takes = (item_before == NOTHING) & (item_after != NOTHING)
    puts = (item_before != NOTHING) & (item_after == NOTHING)
    at_pot = cell_before >= POT
    at_counter = (cell_before >= COUNTER) & (cell_before < POT)
    starts = at_pot & (cell_before < COOKING) & (cell_after >= COOKING)
    return {
        "onion taken": takes & (cell_before == ONIONS),
        "onion put into a pot": puts & at_pot,
        "pot started": starts & (item_before == NOTHING),
        "dish taken": takes & (cell_before == DISHES),
        "soup taken from a pot": (item_before == DISH) & (item_after > SOUP),
        "soup served": puts & (cell_before == SERVING) & (item_before == SOUP + CAPACITY),
        "item put on a counter": puts & at_counter,
        "item taken from a counter": takes & at_counter,
    }


def _use(cell: int, item: int, start: StartCooking) -> tuple[int, int, bool]:
    """Use a cell.

    Args:
        cell: State of the cell.
        item: Item in the hand that uses it.
        start: Rule that starts a pot.

    Returns:
        The state of the cell and the item in the hand after it, and whether the team is rewarded.
    """
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
