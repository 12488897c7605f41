"""One actor for all agents and a centralized critic: MAPPO, and the skill discoverer of HMASD."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int

from hmasd_jax.networks.recurrent import apply
from hmasd_jax.rl.categorical import categorical, mask_logits
from hmasd_jax.rl.ppo import PPOConfig, has_choice, masked_mean, ppo_loss
from hmasd_jax.rl.rollout import cut, flatten
from hmasd_jax.rl.value_norm import ValueNorm, normalize
from hmasd_jax.types import Metrics

if TYPE_CHECKING:
    from distrax import Categorical

NETWORKS = ("actor", "critic")
"""Names of the two networks in the parameters."""


class ActorCriticMemory(NamedTuple):
    """Recurrent memories: the actor's per agent, the critic's per value."""

    actor: Float[Array, "*batch N hidden"]
    critic: Float[Array, "*values hidden"]


class SequenceBatch(NamedTuple):
    """Sequences of L consecutive steps of one environment copy, sample axis first.

    There are V values per step: one for all agents or one per agent.
    """

    memory: ActorCriticMemory
    """Memory before the first step, as it was when acting: (S, ...) without L."""
    first: Bool[Array, "S L"]
    obs: Float[Array, "S L N obs"]
    state: Float[Array, "S L *V state"]
    """Input of the critic."""
    action_mask: Bool[Array, "S L N actions"]
    action: Int[Array, "S L N"]
    log_prob: Float[Array, "S L N"]
    value: Float[Array, "S L *V"]
    """Values of the critic when acting, in normalized units."""
    advantage: Float[Array, "S L N"]
    target: Float[Array, "S L #N"]
    """Returns in reward units."""
    skills: Int[Array, "S L tokens"] | None = None
    """Z, then z^1..z^N, where there are skills."""


def sequences(steps: SequenceBatch, length: int) -> SequenceBatch:
    """Cut a rollout (T, E, ...) into sequences of L = `length` steps, (T / L * E, L, ...).

    `steps.memory` is the memory before every step. Each sequence keeps that before its first.
    """
    memory = flatten(jax.tree.map(lambda x: x[::length], steps.memory))
    return _map_steps(lambda x: cut(x, length), steps)._replace(memory=memory)


def _map_steps(fn: Callable[[Array], Array], batch: SequenceBatch) -> SequenceBatch:
    """Apply `fn` to the arrays with a time axis: all but the memory."""
    arrays = {name: x for name, x in batch._asdict().items() if name != "memory" and x is not None}
    return batch._replace(**jax.tree.map(fn, arrays))


@dataclass(frozen=True)
class ActorCritic:
    """The two networks, which share nothing. Parameters are a dict with the names `NETWORKS`."""

    actor: nn.Module
    critic: nn.Module

    def act(
        self,
        params: dict,
        memory: Float[Array, "*batch N hidden"],
        obs: Float[Array, "*time_batch N obs"],
        action_mask: Bool[Array, "*time_batch N actions"],
        first: Bool[Array, "*time_batch"],
        skill: Int[Array, "*time_batch N"] | None = None,
    ) -> tuple[Float[Array, "*batch N hidden"], "Categorical"]:
        """Return the actor's next memory and pi(a^i|o^i), which may depend on a skill.

        The inputs other than `memory` belong to a single step, or have a leading time axis.
        """
        if obs.ndim == memory.ndim:
            return _single_step(self.act, params, memory, obs, action_mask, first, skill)
        first = jnp.broadcast_to(first[..., None], obs.shape[:-1])
        memory, logits = apply(self.actor, params["actor"], memory, obs, first, skill)
        return memory, categorical(mask_logits(logits, action_mask))

    def value(
        self,
        params: dict,
        memory: Float[Array, "*values hidden"],
        state: Float[Array, "*time_values state"],
        first: Bool[Array, "*time_batch"],
        skill: Int[Array, "*time_values"] | None = None,
    ) -> tuple[Float[Array, "*values hidden"], Float[Array, "*time_values"]]:
        """Return the critic's next memory and V(s) in normalized units, for inputs as in `act`."""
        if state.ndim == memory.ndim:
            return _single_step(self.value, params, memory, state, first, skill)
        if first.ndim < state.ndim - 1:  # one value per agent
            first = jnp.broadcast_to(first[..., None], state.shape[:-1])
        memory, value = apply(self.critic, params["critic"], memory, state, first, skill)
        return memory, value[..., 0]


def _single_step(method, params, memory, *inputs):
    """Call `act` or `value` with a time axis of length 1."""
    memory, outputs = method(params, memory, *jax.tree.map(lambda x: x[None], inputs))
    return memory, outputs[0]


def sequence_loss(
    params: dict,
    networks: ActorCritic,
    norm: ValueNorm,
    batch: SequenceBatch,
    config: PPOConfig,
    entropy_coef: float | Float[Array, ""],
) -> tuple[Float[Array, ""], Metrics]:
    """Replay the networks over sequences and return `agents_loss`.

    With skills, the actor sees each agent's own and the critic sees the team's.
    """
    # (S, L, ...) -> (L, S, ...): recurrent networks run over the first axis.
    batch = _map_steps(lambda x: x.swapaxes(0, 1), batch)
    team_skill, skills = None, None
    if batch.skills is not None:
        team_skill, skills = batch.skills[..., 0], batch.skills[..., 1:]
    _, distribution = networks.act(
        params, batch.memory.actor, batch.obs, batch.action_mask, batch.first, skills
    )
    _, value = networks.value(params, batch.memory.critic, batch.state, batch.first, team_skill)
    # One value for all agents has no axis V yet.
    values = (*batch.first.shape, -1)
    batch = batch._replace(value=batch.value.reshape(values))
    return agents_loss(distribution, value.reshape(values), batch, norm, config, entropy_coef)


def agents_loss(
    distribution: "Categorical",
    value: Float[Array, "*batch #N"],
    batch: Any,
    norm: ValueNorm,
    config: PPOConfig,
    entropy_coef: float | Float[Array, ""],
) -> tuple[Float[Array, ""], Metrics]:
    """Return L_PPO (Eq. 5) of all agents minus their weighted entropy.

    Policy loss and entropy are means over the agents that have a choice, which excludes the dead.
    The value loss is a mean over all agents.

    Args:
        distribution: actions under the parameters that learn.
        value: output of the critic that learns, in normalized units.
        batch: samples with fields `action`, `action_mask`, `log_prob`, `advantage` (*batch, N),
            and `value` (normalized units) and `target` (reward units), which broadcast with
            `value`.
        norm: units of the critic.
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
