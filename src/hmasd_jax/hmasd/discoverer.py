"""The skill discoverer: actor pi_l(a|o, z) and centralized critic V_l(s, Z) (Sec. 3.2, Eq. 7)."""

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int

from envs_jax import Environment
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.networks import actor_critic
from hmasd_jax.networks.actor_critic import ActorCritic, ActorCriticMemory, agents_loss
from hmasd_jax.networks.recurrent import RecurrentNet
from hmasd_jax.networks.transformer import SMALL_GAIN
from hmasd_jax.rl.value_norm import ValueNorm
from hmasd_jax.types import Metrics

if TYPE_CHECKING:
    from distrax import Categorical


class LowBatch(NamedTuple):
    """Sequences of L consecutive steps of one environment copy, sample axis first."""

    memory: ActorCriticMemory
    """Memory before the first step, as it was when acting: (S, ...) without L."""
    first: Bool[Array, "S L"]
    obs: Float[Array, "S L N obs"]
    state: Float[Array, "S L state"]
    action_mask: Bool[Array, "S L N actions"]
    skills: Int[Array, "S L tokens"]
    """Z, then z^1..z^N."""
    action: Int[Array, "S L N"]
    log_prob: Float[Array, "S L N"]
    value: Float[Array, "S L"]
    advantage: Float[Array, "S L N"]
    target: Float[Array, "S L N"]
    """Returns in reward units."""


def make_discoverer(env: Environment, config: HMASDConfig) -> ActorCritic:
    """Actor and critic for `env`; they share nothing."""
    size = config.ppo.hidden_size
    return ActorCritic(
        actor=RecurrentNet(env.num_actions, size, SMALL_GAIN, config.skill_at),
        critic=RecurrentNet(1, size, 1.0, config.skill_at),
    )


def init_memory(batch_shape: tuple[int, ...], num_agents: int, size: int) -> ActorCriticMemory:
    """Memory before the first step."""
    return ActorCriticMemory(
        jnp.zeros((*batch_shape, num_agents, size)), jnp.zeros((*batch_shape, size))
    )


def action_distribution(
    network: nn.Module,
    params: dict,
    memory: Float[Array, "*batch N hidden"],
    obs: Float[Array, "time *batch N obs"],
    action_mask: Bool[Array, "time *batch N actions"],
    skills: Int[Array, "time *batch N"],
    first: Bool[Array, "time *batch"],
    num_skills: int,
) -> tuple[Float[Array, "*batch N hidden"], "Categorical"]:
    """pi_l(a^i|o^i, z^i) at every step; an agent sees its own skill, not the team's."""
    condition = jax.nn.one_hot(skills, num_skills)
    return actor_critic.action_distribution(
        network, params, memory, obs, action_mask, first, condition
    )


def state_value(
    network: nn.Module,
    params: dict,
    memory: Float[Array, "*batch hidden"],
    state: Float[Array, "time *batch state"],
    team_skill: Int[Array, "time *batch"],
    first: Bool[Array, "time *batch"],
    num_team_skills: int,
) -> tuple[Float[Array, "*batch hidden"], Float[Array, "time *batch"]]:
    """V_l(s, Z) in normalized units, once per copy: its inputs are the same for all agents."""
    condition = jax.nn.one_hot(team_skill, num_team_skills)
    return actor_critic.state_value(network, params, memory, state, first, condition)


def discoverer_loss(
    params: dict,
    networks: ActorCritic,
    norm: ValueNorm,
    batch: LowBatch,
    config: HMASDConfig,
    entropy_coef: float | Float[Array, ""] | None = None,
) -> tuple[Float[Array, ""], Metrics]:
    """Eq. 7: L_l = sum_i L_PPO{pi_l(a^i|o^i, z^i), V_l(s, Z), r^i} - lambda_l sum_i E[H(pi_l)].

    As in the authors' code the sums over agents are means, for policy and entropy over those who
    have a choice: not over the dead. The one V_l(s, Z) is fitted to the returns of all agents.
    `entropy_coef` is lambda_l where it is not the configured constant.
    """
    if entropy_coef is None:
        entropy_coef = config.low_entropy_coef
    # (S, L, ...) -> (L, S, ...): recurrent networks run over the first axis.
    batch = LowBatch(batch.memory, *(x.swapaxes(0, 1) for x in batch[1:]))
    _, distribution = action_distribution(
        networks.actor,
        params["actor"],
        batch.memory.actor,
        batch.obs,
        batch.action_mask,
        batch.skills[..., 1:],
        batch.first,
        config.num_skills,
    )
    _, value = state_value(
        networks.critic,
        params["critic"],
        batch.memory.critic,
        batch.state,
        batch.skills[..., 0],
        batch.first,
        config.num_team_skills,
    )
    batch = batch._replace(value=batch.value[..., None])  # one for all agents
    return agents_loss(distribution, value[..., None], batch, norm, config.ppo, entropy_coef)
