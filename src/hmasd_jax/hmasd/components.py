"""The networks and optimizers of HMASD for one environment."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import optax

from envs_jax import Environment
from hmasd_jax.exploration.bonus import Bonus, add
from hmasd_jax.exploration.frontier import make_frontier
from hmasd_jax.exploration.novelty import make_novelty
from hmasd_jax.exploration.successes import Imitation, make_imitation
from hmasd_jax.hmasd.ablations import make_coordinator
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.coordinator import Coordinator
from hmasd_jax.hmasd.discoverer import init_memory, make_discoverer
from hmasd_jax.hmasd.discriminators import (
    Discriminators,
    SkillPair,
    make_discriminators,
    observe,
)
from hmasd_jax.hmasd.distance import SkillReward, make_distance
from hmasd_jax.networks.actor_critic import NETWORKS, ActorCritic
from hmasd_jax.rl.keys import key_beside
from hmasd_jax.rl.sgd import make_optimizer
from hmasd_jax.types import Key, Learner
from hmasd_jax.validation import ConfigError


@dataclass(frozen=True)
class Parts:
    """Static components that the pure functions of HMASD take."""

    env: Environment
    config: HMASDConfig
    coordinator: Coordinator
    discoverer: ActorCritic
    discriminators: Discriminators
    coordinator_optimizer: optax.GradientTransformationExtraArgs
    discoverer_optimizer: optax.GradientTransformationExtraArgs
    discriminator_optimizer: optax.GradientTransformation
    distance: SkillReward
    bonus: Bonus
    imitation: Imitation


def make_parts(env: Environment, config: HMASDConfig) -> Parts:
    """Build networks and optimizers without initializing parameters.

    Raises:
        ConfigError: `discriminator_obs` names a feature that obs does not have.
    """
    ppo = config.ppo
    last = max(config.discriminator_obs, default=0)
    if last >= env.obs_dim:
        raise ConfigError(
            f"algorithm.discriminator_obs has index {last}, but obs has {env.obs_dim} features "
            f"(0 to {env.obs_dim - 1})"
        )
    discoverer = make_discoverer(env, config)
    low_steps = ppo.steps_per_update + config.imitation.steps_per_update
    return Parts(
        env=env,
        config=config,
        coordinator=make_coordinator(config),
        discoverer=discoverer,
        discriminators=make_discriminators(config),
        coordinator_optimizer=make_optimizer(ppo, ["params"]),
        discoverer_optimizer=make_optimizer(ppo, NETWORKS, low_steps),
        discriminator_optimizer=make_optimizer(
            ppo, Discriminators._fields, config.discriminator_epochs
        ),
        distance=make_distance(env, config.num_team_skills, config.num_skills, config.distance),
        bonus=add(
            make_novelty(env, config.novelty), make_frontier(env, config.frontier, ppo.num_envs)
        ),
        imitation=make_imitation(env, discoverer, config.imitation, ppo, has_skills=True),
    )


def init_learners(parts: Parts, key: Key) -> tuple[Learner, Learner, Learner]:
    """Initialize coordinator, discoverer and discriminators."""
    env, config = parts.env, parts.config
    key_coordinator, key_actor, key_critic, key_team, key_individual = jax.random.split(key, 5)
    state, obs = jnp.zeros((1, env.state_dim)), jnp.zeros((1, env.num_agents, env.obs_dim))
    first = jnp.zeros((1, env.num_agents), bool)
    memory = init_memory((), env.num_agents, config.ppo.hidden_size)
    actor, critic = parts.discoverer.actor, parts.discoverer.critic
    tokens = jnp.zeros((1, 1 + env.num_agents), int)
    q_team, q_individual = parts.discriminators
    seen = observe(SkillPair(state=state, obs=obs, skills=tokens), config, key_beside(key, 0))
    team_skills = jnp.zeros((1, env.num_agents, config.num_team_skills))
    coordinator = parts.coordinator.init(key_coordinator, state, obs, tokens)
    discoverer = {
        "actor": actor.init(key_actor, memory.actor, obs, first, tokens[:, 1:]),
        "critic": critic.init(key_critic, memory.critic, state, first[:, 0], tokens[:, 0]),
    }
    discriminators = {
        "team": q_team.init(key_team, state),
        "individual": q_individual.init(
            key_individual, jnp.concatenate([seen.obs, team_skills], axis=-1)
        ),
    }
    return (
        Learner(coordinator, parts.coordinator_optimizer.init(coordinator)),
        Learner(discoverer, parts.discoverer_optimizer.init(discoverer)),
        Learner(discriminators, parts.discriminator_optimizer.init(discriminators)),
    )
