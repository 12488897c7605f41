"""Global state of Overcooked in the frame of the kitchen: every cook and every pot, once.

The observations of `features` are relative. Their closest pot is now this pot and now that one, as
the observer walks. Here each pot has numbers of its own, and each cook those of its seat. If they
went with the agents, who change seats, then what one cook never does would hide in what the other
always does. The numbers are:

- for each player (9): orientation (4: N S E W), held item (3: onion, dish, soup), x, y
- for each pot (5): its onions, holds three, is cooking, is ready, steps until it is ready
- 1 if agent 0 is player 1, else 0

Objects on counters and the time are left out, as they are in `features`.
"""

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs_jax.overcooked.layouts import read
from envs_jax.overcooked.rules import (
    CAPACITY,
    DISH,
    NUM_ITEMS,
    NUM_POT_STATES,
    ONION,
    POT,
    READY,
    SOUP,
    read_pot,
    steps_until_ready,
)

PLAYER_NUMBERS, POT_NUMBERS, SEAT_NUMBERS = 9, 5, 1


def state_dim(layout: str) -> int:
    """Return the length of the state of a kitchen."""
    return 2 * PLAYER_NUMBERS + POT_NUMBERS * len(read(layout).pots) + SEAT_NUMBERS


def encode(
    layout: str,
    pose: Int[Array, "2"],
    held: Int[Array, "2"],
    grid: Int[Array, " cells"],
    swapped: Bool[Array, ""],
) -> Float[Array, " state"]:
    """Encode the state as a sum of table rows.

    Args:
        layout: Name or text of the kitchen.
        pose: Pose of each player.
        held: Item that each of them holds.
        grid: State of each cell.
        swapped: True if agent 0 is player 1.
    """
    players, pots = _tables(layout)
    first, second = NUM_ITEMS * pose + held
    state = jnp.asarray(players[0])[first] + jnp.asarray(players[1])[second]
    for table, cell in zip(pots, read(layout).pots, strict=True):
        state += jnp.asarray(table)[grid[cell] - POT]
    return state.at[-1].set(swapped).astype(jnp.float32)


@lru_cache
def _tables(layout: str) -> tuple[np.ndarray, np.ndarray]:
    """Compute what each player adds, by pose and item, and each pot, by its state."""
    kitchen, width = read(layout), state_dim(layout)
    players = np.zeros((2, 4 * len(kitchen.grid), NUM_ITEMS, width), np.int8)
    pots = np.zeros((len(kitchen.pots), NUM_POT_STATES, width), np.int8)
    cell, orientation = np.divmod(np.arange(4 * len(kitchen.grid)), 4)
    for player, table in enumerate(players):
        own = table[..., PLAYER_NUMBERS * player :]
        own[..., :4] = (orientation[:, None] == np.arange(4))[:, None]
        own[:, ONION, 4] = own[:, DISH, 5] = own[:, SOUP + 1 :, 6] = 1
        own[..., 7:9] = kitchen.xy(cell).T[:, None]
    for pot, table in enumerate(pots):
        begin = 2 * PLAYER_NUMBERS + POT_NUMBERS * pot
        table[:, begin : begin + POT_NUMBERS] = [_pot_numbers(s) for s in range(NUM_POT_STATES)]
    return players.reshape(2, -1, width), pots


def _pot_numbers(state: int) -> tuple[int, ...]:
    """Return the numbers of a pot by its state, counted from that of an empty pot."""
    onions, cooked = read_pot(POT + state)
    remaining = steps_until_ready(cooked)
    return onions, onions == CAPACITY, remaining > 0, cooked == READY, remaining
