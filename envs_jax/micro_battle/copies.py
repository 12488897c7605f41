"""Batching with the copies of an environment last."""

from collections.abc import Callable
from functools import lru_cache

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap


@lru_cache  # Calls without jit reuse the compiled function.
def copies_last(function: Callable) -> Callable:
    """Wrap `function` so that `jax.vmap` calls it with the copies axis last in all arrays.

    Arrays of a few units are then long in their last axis, which XLA's loops on a CPU run over.
    """
    batched = custom_vmap(jax.jit(function))

    @batched.def_vmap
    def rule(size, is_batched, *args):
        def move(x, has_copies):
            if has_copies:
                return jnp.moveaxis(x, 0, -1)
            return jnp.broadcast_to(x[..., None], (*x.shape, size))

        out = copies_last(function)(*jax.tree.map(move, args, tuple(is_batched)))
        out = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), out)
        return out, jax.tree.map(lambda _: True, out)

    return batched
