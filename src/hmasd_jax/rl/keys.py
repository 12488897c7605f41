"""Keys beside those of a split."""

import jax

from hmasd_jax.types import Key

FIRST = 2**31
"""First number to fold in, which no split reaches."""


def key_beside(key: Key, number: int) -> Key:
    """Return a key that differs from every key of `jax.random.split(key, n)`.

    Optional parts draw with such keys, so that the draws of other parts stay as they are. JAX makes
    key i of a split by folding i into the key. A small number would return one of those keys again.

    Args:
        key: key that is split elsewhere.
        number: which of the keys beside to return, from 0.
    """
    return jax.random.fold_in(key, FIRST + number)
