"""The skill discoverer: actor pi_l(a|o, z) and centralized critic V_l(s, Z) (Sec. 3.2, Eq. 7)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from envs_jax import Environment
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.networks.actor_critic import (
    ActorCritic,
    ActorCriticMemory,
    SequenceBatch,
    sequence_loss,
)
from hmasd_jax.networks.recurrent import SMALL_GAIN, RecurrentNet
from hmasd_jax.rl.value_norm import ValueNorm
from hmasd_jax.types import Metrics


def make_discoverer(env: Environment, config: HMASDConfig) -> ActorCritic:
    """Build actor and critic for `env`.

    The actor sees each agent's observation and skill z^i. The critic sees state and team skill Z,
    and gives one value for all agents.
    """
    size, at = config.ppo.hidden_size, config.skill_at
    return ActorCritic(
        actor=RecurrentNet(env.num_actions, size, SMALL_GAIN, config.num_skills, at),
        critic=RecurrentNet(1, size, 1.0, config.num_team_skills, at),
    )


def init_memory(batch_shape: tuple[int, ...], num_agents: int, size: int) -> ActorCriticMemory:
    """Return the memory before the first step."""
    return ActorCriticMemory(
        actor=jnp.zeros((*batch_shape, num_agents, size)), critic=jnp.zeros((*batch_shape, size))
    )


def discoverer_loss(
    params: dict,
    networks: ActorCritic,
    norm: ValueNorm,
    batch: SequenceBatch,
    config: HMASDConfig,
    entropy_coef: float | Float[Array, ""] | None = None,
) -> tuple[Float[Array, ""], Metrics]:
    """Eq. 7: L_l = sum_i L_PPO{pi_l(a^i|o^i, z^i), V_l(s, Z), r^i} - lambda_l sum_i E[H(pi_l)].

    The sums over agents are means, like in the authors' code. Those of policy and entropy exclude
    agents without a choice, the dead. The one V_l(s, Z) is fitted to the returns of all agents.
    `entropy_coef` overrides lambda_l of the configuration.
    """
    if entropy_coef is None:
        entropy_coef = config.low_entropy_coef
    return sequence_loss(params, networks, norm, batch, config.ppo, entropy_coef)
