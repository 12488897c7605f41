"""A pytree of arrays, typed PRNG keys among them, as bytes, and back."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Tree = Any
"""A pytree of arrays or of `jax.ShapeDtypeStruct`s."""


def describe(tree: Tree) -> dict[str, str]:
    """Dtype and shape of every array, by name."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path): f"{x.dtype}{list(x.shape)}" for path, x in leaves}


def to_bytes(tree: Tree) -> bytes:
    """All arrays in order."""
    return b"".join(np.asarray(_raw(x)).tobytes() for x in jax.tree.leaves(tree))


def from_bytes(data: bytes, template: Tree) -> Tree:
    """Inverse of `to_bytes`; arrays go where those of the template are, or to the default."""
    leaves, structure = jax.tree.flatten(template)
    arrays, begin = [], 0
    for leaf in leaves:
        raw = jax.eval_shape(_raw, leaf)
        # A copy: jax would otherwise read, and when donated overwrite, the memory of `data`.
        array = jnp.array(np.frombuffer(data, raw.dtype, raw.size, begin).reshape(raw.shape))
        begin += array.nbytes
        array = jax.random.wrap_key_data(array) if _is_key(leaf) else array
        arrays.append(jax.device_put(array, getattr(leaf, "sharding", None)))
    return jax.tree.unflatten(structure, arrays)


def _raw(x: jax.Array) -> jax.Array:
    """Keys as the integers that they are made of."""
    return jax.random.key_data(x) if _is_key(x) else x


def _is_key(x: jax.Array | jax.ShapeDtypeStruct) -> bool:
    return jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)
