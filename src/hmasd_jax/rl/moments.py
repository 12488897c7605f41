"""Running mean and variance of everything seen so far, for inputs whose scale is unknown."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

MIN_VARIANCE = 1e-4
"""Added to every variance, so that features that never change stay near 0."""


class Moments(NamedTuple):
    """Mean and population variance of each feature over `count` samples."""

    mean: Float[Array, "*features"]
    variance: Float[Array, "*features"]
    count: Float[Array, ""]

    @classmethod
    def create(cls, *shape: int) -> "Moments":
        """Return the moments of no samples: mean 0, variance 1."""
        return cls(jnp.zeros(shape), jnp.ones(shape), jnp.float32(0))


def update(moments: Moments, x: Float[Array, "..."]) -> Moments:
    """Merge the moments with those of a batch (Chan et al., 1979).

    `x` has the shape (*batch, *features), and the moments have (*features).
    """
    batch = tuple(range(x.ndim - moments.mean.ndim))
    count = x.size / max(moments.mean.size, 1)
    total = moments.count + count
    shift = x.mean(batch) - moments.mean
    old, new = moments.count / total, count / total
    return Moments(
        mean=moments.mean + shift * new,
        variance=moments.variance * old + x.var(batch) * new + shift**2 * old * new,
        count=total,
    )


def standardize(
    moments: Moments, x: Float[Array, "*batch_features"], clip: float
) -> Float[Array, "*batch_features"]:
    """Shift and scale (*batch, *features) to mean 0 and variance 1, and clip to [-clip, clip]."""
    scaled = (x - moments.mean) / jnp.sqrt(moments.variance + MIN_VARIANCE)
    return jnp.clip(scaled, -clip, clip)
