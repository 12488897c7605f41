"""Running mean and variance of value targets ("use valuenorm", Table 1)."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

DECAY = 0.99999
MIN_WEIGHT = 1e-5
MIN_VARIANCE = 1e-2


class ValueNorm(NamedTuple):
    """Exponential averages of x, x^2 and 1. The last removes the bias towards zero.

    There is one for all values, or one per value where algorithms map these functions over them.
    """

    mean: Float[Array, "*values"]
    square: Float[Array, "*values"]
    weight: Float[Array, "*values"]

    @classmethod
    def create(cls) -> "ValueNorm":
        """Return the statistics before any data: mean 0, standard deviation 0.1."""
        return cls(jnp.float32(0), jnp.float32(0), jnp.float32(0))


def update(norm: ValueNorm, target: Float[Array, "*batch"]) -> ValueNorm:
    """Update the averages with one batch of raw targets (on-policy `valuenorm.py`)."""
    batch = (target.mean(), (target**2).mean(), 1.0)
    return ValueNorm(*(DECAY * old + (1.0 - DECAY) * new for old, new in zip(norm, batch)))


def statistics(norm: ValueNorm) -> tuple[Float[Array, "*values"], Float[Array, "*values"]]:
    """Return the debiased mean and standard deviation, in reward units."""
    weight = jnp.maximum(norm.weight, MIN_WEIGHT)
    mean, square = norm.mean / weight, norm.square / weight
    return mean, jnp.sqrt(jnp.maximum(square - mean**2, MIN_VARIANCE))


def normalize(norm: ValueNorm, x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Convert reward units to units of standard deviations."""
    mean, std = statistics(norm)
    return (x - mean) / std


def denormalize(norm: ValueNorm, x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Convert units of standard deviations to reward units."""
    mean, std = statistics(norm)
    return x * std + mean
