"""Counts of any number of keys in a table of fixed size: a count-min sketch.

The table has rows with a hash function each (Cormode and Muthukrishnan, 2005). A key is counted in
one slot of every row, and its count is the smallest of these. Keys that share a slot with another
in every row are counted too often, never too rarely.
"""

from functools import reduce

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

ROWS = 2
SALTS = (0x9E3779B9, 0x7F4A7C15)
"""Number that makes the hash function of each row another one."""

Table = Int[Array, "rows slots"]
Keys = UInt32[Array, "*batch"]


def init(size: int) -> Table:
    """Return a table of zeros."""
    return jnp.zeros((ROWS, size), jnp.int32)


def mix(x: Keys) -> Keys:
    """Map 32 bits to 32 others one to one, such that similar inputs become dissimilar.

    The constants are those of the last step of MurmurHash3.
    """
    x = (x ^ (x >> 16)) * jnp.uint32(0x85EBCA6B)
    x = (x ^ (x >> 13)) * jnp.uint32(0xC2B2AE35)
    return x ^ (x >> 16)


def make_key(*parts: Array | np.ndarray | int) -> Keys:
    """Hash whole numbers, which broadcast against each other. Their order matters."""
    words = [jnp.asarray(part).astype(jnp.uint32) for part in parts]
    return reduce(lambda key, word: mix(key * jnp.uint32(31) + word), words, jnp.uint32(1))


def _slots(table: Table, keys: Keys) -> Int[Array, "rows *batch"]:
    salts = jnp.array(SALTS, jnp.uint32).reshape(-1, *[1] * keys.ndim)
    return (mix(keys ^ salts) % table.shape[1]).astype(jnp.int32)


def _rows(keys: Keys) -> Int[Array, "rows *ones"]:
    return jnp.arange(ROWS).reshape(-1, *[1] * keys.ndim)


def add(table: Table, keys: Keys, times: int | Int[Array, ""] = 1) -> Table:
    """Count every key `times` more; one that occurs several times, several times as often.

    In a loop, add before you `read`. A table that is read first would be copied at each turn, which
    takes hundreds of times as long.
    """
    return table.at[_rows(keys), _slots(table, keys)].add(times)


def read(table: Table, keys: Keys) -> Float[Array, "*batch"]:
    """Return the count of each key."""
    return table[_rows(keys), _slots(table, keys)].min(axis=0).astype(jnp.float32)


def load(table: Table) -> Float[Array, ""]:
    """Return the share of slots in use, p. A new key's count is wrong with chance p^`ROWS`."""
    return (table[0] > 0).mean()
