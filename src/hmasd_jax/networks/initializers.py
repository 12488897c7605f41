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


def uniform(fan_in: int) -> nn.initializers.Initializer:
    """Build PyTorch's default for weights and biases: uniform in +-1 / sqrt(fan_in)."""

    def init(key: Key, shape: Sequence[int], dtype: DTypeLike = jnp.float32) -> Float[Array, "..."]:
        bound = fan_in**-0.5
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return init
