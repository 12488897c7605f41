"""Initial weights."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from hmasd_jax.types import Key


def orthogonal(gain: float) -> nn.initializers.Initializer:
    """Build an orthogonal initializer that draws one matrix at a time, also under `jax.vmap`.

    jaxlib's batched QR decomposition waits in a thread of the CPU's pool for tasks that it gives to
    the same pool. With as many decompositions as threads, all wait for each other forever. Two
    cores are enough to hang a vmapped `init` (jaxlib 0.10.1).
    """
    draw = nn.initializers.orthogonal(gain)

    def init(
        key: Key, shape: Sequence[int], dtype: DTypeLike = jnp.float32
    ) -> Float[Array, "inputs outputs"]:
        return jax.custom_batching.sequential_vmap(lambda key: draw(key, shape, dtype))(key)

    return init
