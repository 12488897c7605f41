"""Uniformly random play, the baseline that every learner has to beat."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int


def random_actions(
    key: jax.Array, action_mask: Bool[Array, "*batch agents actions"]
) -> Int[Array, "*batch agents"]:
    """Draw a legal action for every agent, uniformly over its legal actions."""
    # Draw n uniformly and take the action that has n legal actions before it. This needs one
    # random number per agent, whereas a categorical draw needs one per action.
    legal = jnp.cumsum(action_mask, axis=-1)
    before = jnp.floor(jax.random.uniform(key, legal.shape[:-1]) * legal[..., -1])
    return (legal <= before[..., None]).sum(-1)
