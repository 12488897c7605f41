"""Uniformly random play, the floor that every learner is measured against."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int


def random_actions(
    key: jax.Array, action_mask: Bool[Array, "*batch agents actions"]
) -> Int[Array, "*batch agents"]:
    """Draw a legal action for every agent, each as likely as the others."""
    # The action with n legal ones before it, n uniform: one random number per agent, where a
    # categorical draw takes one per action.
    legal = jnp.cumsum(action_mask, axis=-1)
    before = jnp.floor(jax.random.uniform(key, legal.shape[:-1]) * legal[..., -1])
    return (legal <= before[..., None]).sum(-1)
