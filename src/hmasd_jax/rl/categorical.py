"""Categorical distributions over actions and skills, some of which may be illegal."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hmasd_jax.types import Key

if TYPE_CHECKING:
    from distrax import Categorical

MASKED_LOGIT = -1e10
"""Logit of an illegal action: its probability is 0, and gradients stay finite."""


def categorical(logits: Float[Array, "*batch choices"]) -> "Categorical":
    """Build a distrax distribution from logits.

    The first call imports distrax, which takes as long to import as jax and is needed neither for
    settings nor for `--help`.
    """
    from distrax import Categorical

    return Categorical(logits=logits)


def choose(
    distribution: "Categorical", greedy: bool | Bool[Array, "*#batch"], key: Key
) -> Int[Array, "*batch"]:
    """Sample from a distribution, or take its most likely value where `greedy`."""
    if isinstance(greedy, bool):
        return jnp.asarray(distribution.mode() if greedy else distribution.sample(seed=key))
    return jnp.where(greedy, distribution.mode(), distribution.sample(seed=key))


def mask_logits(
    logits: Float[Array, "*batch choices"], mask: Bool[Array, "*#batch choices"]
) -> Float[Array, "*batch choices"]:
    """Make illegal choices impossible."""
    return jnp.where(mask, logits, MASKED_LOGIT)
