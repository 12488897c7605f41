"""Pairs of features whose joint values few parts of episodes reach.

Where single features say nothing new, pairs of them may. Cooks who bring onions one after the other
reach all values of both their hands, but never hold two onions at a time. CMAE, too, goes on to
larger projections of the state once the smaller ones are explored (Liu et al., ICML 2021).

The values of two features fall into a cell of a table with a few bins a side. A part of an episode
is paid when it comes to a cell for the first time, by how few parts do, as for single features.
Bins follow the extremes of a feature so far. If these widen, its cells move, and their shares are
those of the old ones until enough parts have been counted.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from hmasd_jax.exploration.frontier_config import FrontierConfig
from hmasd_jax.exploration.visits import largest_share, odds_against, pay

BINS = 4
"""Bins per feature of a pair. `Pairs.visited` has room for at most 32 cells, and so for 5 bins."""

MOST_PAIRS = 512
"""Most pairs that are counted. Of 33 features or more, these are drawn once and for all."""


class Pairs(NamedTuple):
    """Visits to the cells of P pairs in E copies of the environment."""

    reached: Float[Array, "P cells"]
    """Number of recent parts of episodes that came to each cell."""
    parts: Float[Array, ""]
    """Number of recent parts."""
    mastered: Float[Array, "P cells"]
    """Largest share of parts so far that came to each cell, less what is forgotten."""
    visited: UInt32[Array, "E P"]
    """Cells that the part under way has come to, one bit each."""


def init_pairs(state_dim: int, num_envs: int) -> Pairs:
    """Return pairs of `state_dim` features that were not visited yet."""
    num_pairs = len(choose_pairs(state_dim))
    return Pairs(
        reached=jnp.zeros((num_pairs, BINS**2)),
        parts=jnp.float32(num_envs),
        mastered=jnp.zeros((num_pairs, BINS**2)),
        visited=jnp.zeros((num_envs, num_pairs), jnp.uint32),
    )


def choose_pairs(state_dim: int) -> Int[np.ndarray, "P 2"]:
    """Return the features of each pair, smaller index first."""
    pairs = np.stack(np.triu_indices(state_dim, 1), -1)
    if len(pairs) <= MOST_PAIRS:
        return pairs
    return np.random.default_rng(0).permutation(pairs)[:MOST_PAIRS]


def find_cells(bins: Int[Array, "*batch state"]) -> Int[Array, "*batch P"]:
    """Return the cell of each pair, from the bin of each feature."""
    first, second = choose_pairs(bins.shape[-1]).T
    return BINS * bins[..., first] + bins[..., second]


def visit_pairs(
    pairs: Pairs,
    cells: Int[Array, "T E P"],
    part_ends: Bool[Array, "T E"],
    config: FrontierConfig,
) -> tuple[Pairs, Float[Array, "T E"]]:
    """Count the visits of a rollout, and return what its steps are paid.

    Args:
        pairs: state before the rollout.
        cells: cell of each pair after each step.
        part_ends: whether each step ends a part.
        config: all settings but the weights.
    """
    keep = 1.0 - 1.0 / config.window
    reached, parts = keep * pairs.reached, keep * pairs.parts + part_ends.sum()
    visited, reached, is_first = first_cells(pairs.visited, reached, cells, part_ends)
    mastered = largest_share(pairs.mastered, reached, parts, config.forgetting)
    worth = odds_against(mastered, config.largest_worth)
    bonus = pay(is_first, worth[jnp.arange(cells.shape[-1]), cells])
    return Pairs(reached=reached, parts=parts, mastered=mastered, visited=visited), bonus


def first_cells(
    visited: UInt32[Array, "E P"],
    reached: Float[Array, "P cells"],
    cells: Int[Array, "T E P"],
    part_ends: Bool[Array, "T E"],
) -> tuple[UInt32[Array, "E P"], Float[Array, "P cells"], Bool[Array, "T E P"]]:
    """Find the steps that come to a cell as the first of their part, and count them.

    A step that begins a part comes to the cell that it ends in.

    Returns:
        Cells that the parts under way have come to, `reached` with the new visits, and whether each
        step is the first of its part in its cell.
    """
    pair = jnp.arange(cells.shape[-1])

    # Counting after the scan, in one scatter over all steps, takes several times as long.
    def step(carry, x):
        visited, reached = carry
        cells, ends = x
        here = jnp.left_shift(jnp.uint32(1), cells.astype(jnp.uint32))
        is_first = (visited & here) == 0
        reached = reached.at[pair, cells].add(is_first)
        return (jnp.where(ends[:, None], 0, visited | here), reached), is_first

    (visited, reached), is_first = jax.lax.scan(step, (visited, reached), (cells, part_ends))
    return visited, reached, is_first
