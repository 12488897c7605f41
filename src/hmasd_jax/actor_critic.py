"""One actor for all agents and a centralized critic: MAPPO, and the skill discoverer of HMASD."""

from typing import NamedTuple

import distrax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from hmasd_jax.networks import apply, mask_logits


class ActorCritic(NamedTuple):
    """The two networks, which share nothing; parameters are a dict with the same names."""

    actor: nn.Module
    critic: nn.Module


class ActorCriticMemory(NamedTuple):
    """Recurrent memories: the actor's per agent, the critic's per value."""

    actor: Float[Array, "*batch N hidden"]
    critic: Float[Array, "*values hidden"]


def action_distribution(
    network: nn.Module,
    params: dict,
    memory: Float[Array, "*batch N hidden"],
    obs: Float[Array, "time *batch N obs"],
    action_mask: Bool[Array, "time *batch N actions"],
    first: Bool[Array, "time *batch"],
    condition: Float[Array, "time *batch N skills"] | None = None,
) -> tuple[Float[Array, "*batch N hidden"], distrax.Categorical]:
    """pi(a^i|o^i) at every step; `condition` may be a skill."""
    first = jnp.broadcast_to(first[..., None], obs.shape[:-1])
    memory, logits = apply(network, params, memory, obs, first, condition)
    return memory, distrax.Categorical(logits=mask_logits(logits, action_mask))


def state_value(
    network: nn.Module,
    params: dict,
    memory: Float[Array, "*values hidden"],
    state: Float[Array, "time *values state"],
    first: Bool[Array, "time *values"],
    condition: Float[Array, "time *values skills"] | None = None,
) -> tuple[Float[Array, "*values hidden"], Float[Array, "time *values"]]:
    """V(s) at every step, in normalized units; `condition` may be a skill."""
    memory, value = apply(network, params, memory, state, first, condition)
    return memory, value[..., 0]
