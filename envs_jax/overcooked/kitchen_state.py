"""Global state of Overcooked in the frame of the kitchen: every agent and every pot, once.

The observations of `features` are relative. Their closest pot is now this pot and now that one, as
the observer walks. Here each pot has numbers of its own:

- for each agent (9): orientation (4: N S E W), held item (3: onion, dish, soup), x, y
- for each pot (5): its onions, holds three, is cooking, is ready, steps until it is ready

Objects on counters and the time are left out, as they are in `features`.
"""

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

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

AGENT_NUMBERS, POT_NUMBERS = 9, 5


def state_dim(layout: str) -> int:
    """Return the length of the state of a kitchen."""
    return 2 * AGENT_NUMBERS + POT_NUMBERS * len(read(layout).pots)


def encode(
    layout: str,
    pose: Int[Array, "2"],
    held: Int[Array, "2"],
    grid: Int[Array, " cells"],
) -> Float[Array, " state"]:
    """Encode the state as a sum of table rows.

    Args:
        layout: Name or text of the kitchen.
        pose: Pose of each agent's cook.
        held: Item that each of them holds.
        grid: State of each cell.
    """
    agents, pots = _tables(layout)
    first, second = NUM_ITEMS * pose + held
    state = jnp.asarray(agents[0])[first] + jnp.asarray(agents[1])[second]
    for table, cell in zip(pots, read(layout).pots, strict=True):
        state += jnp.asarray(table)[grid[cell] - POT]
    return state.astype(jnp.float32)


@lru_cache
def _tables(layout: str) -> tuple[np.ndarray, np.ndarray]:
    """Compute what each agent adds, by pose and item, and each pot, by its state."""
    kitchen, width = read(layout), state_dim(layout)
    agents = np.zeros((2, 4 * len(kitchen.grid), NUM_ITEMS, width), np.int8)
    pots = np.zeros((len(kitchen.pots), NUM_POT_STATES, width), np.int8)
    cell, orientation = np.divmod(np.arange(4 * len(kitchen.grid)), 4)
    for agent, table in enumerate(agents):
        own = table[..., AGENT_NUMBERS * agent :]
        own[..., :4] = (orientation[:, None] == np.arange(4))[:, None]
        own[:, ONION, 4] = own[:, DISH, 5] = own[:, SOUP + 1 :, 6] = 1
        own[..., 7:9] = kitchen.xy(cell).T[:, None]
    for pot, table in enumerate(pots):
        begin = 2 * AGENT_NUMBERS + POT_NUMBERS * pot
        table[:, begin : begin + POT_NUMBERS] = [_pot_numbers(s) for s in range(NUM_POT_STATES)]
    return agents.reshape(2, -1, width), pots


def _pot_numbers(state: int) -> tuple[int, ...]:
    """Return the numbers of a pot by its state, counted from that of an empty pot."""
    onions, cooked = read_pot(POT + state)
    remaining = steps_until_ready(cooked)
    return onions, onions == CAPACITY, remaining > 0, cooked == READY, remaining
