"""One actor for all agents and a centralized critic: MAPPO, and the skill discoverer of HMASD."""

from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from hmasd_jax.networks.recurrent import apply
from hmasd_jax.rl.categorical import categorical, mask_logits
from hmasd_jax.rl.ppo import PPOConfig, has_choice, masked_mean, ppo_loss
from hmasd_jax.rl.value_norm import ValueNorm, normalize
from hmasd_jax.types import Metrics

if TYPE_CHECKING:
    from distrax import Categorical


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
) -> tuple[Float[Array, "*batch N hidden"], "Categorical"]:
    """pi(a^i|o^i) at every step; `condition` may be a skill."""
    first = jnp.broadcast_to(first[..., None], obs.shape[:-1])
    memory, logits = apply(network, params, memory, obs, first, condition)
    return memory, categorical(mask_logits(logits, action_mask))


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


def agents_loss(
    distribution: "Categorical",
    value: Float[Array, "*batch #N"],
    batch: Any,
    norm: ValueNorm,
    config: PPOConfig,
    entropy_coef: float | Float[Array, ""],
) -> tuple[Float[Array, ""], Metrics]:
    """L_PPO (Eq. 5) of all agents, less their weighted entropy.

    Policy loss and entropy are means over the agents that have a choice, which the dead have not;
    the value loss is of all.

    Args:
        distribution: of the actions, under the parameters that learn.
        value: of the critic that learns, in normalized units.
        batch: what was done: `action`, `action_mask`, `log_prob`, `advantage` (*batch, N), and
            `value` (normalized units) and `target` (reward units), which broadcast with `value`.
        norm: the critic's units.
        config: clip range, value coefficient and Huber threshold.
        entropy_coef: weight of the entropy.
    """
    active = has_choice(batch.action_mask)
    loss, metrics = ppo_loss(
        jnp.asarray(distribution.log_prob(batch.action)), batch.log_prob, batch.advantage,
        value, batch.value, normalize(norm, batch.target), config, active,
    )  # fmt: skip
    entropy = masked_mean(jnp.asarray(distribution.entropy()), active)
    return loss - entropy_coef * entropy, metrics | {"entropy": entropy}
