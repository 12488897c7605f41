"""HMASD: Algorithm 1 of the paper as one pure `update`."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from envs_jax import Environment
from hmasd_jax.exploration.solved import step_factor
from hmasd_jax.hmasd.batches import high_batch, low_batch, skill_pairs, skill_steps
from hmasd_jax.hmasd.coefficients import (
    coordinator_step_factor,
    high_entropy_coef,
    low_entropy_coef,
    random_share,
    sample_weight,
    skill_weight,
    unknown_share,
)
from hmasd_jax.hmasd.components import Parts, init_learners, make_parts
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.coordinator import HighBatch, coordinator_loss
from hmasd_jax.hmasd.discoverer import discoverer_loss
from hmasd_jax.hmasd.discriminators import (
    SkillPair,
    discriminator_loss,
    log_q_of_skills,
    observe,
)
from hmasd_jax.hmasd.policy import make_policy
from hmasd_jax.hmasd.rewards import low_level_reward
from hmasd_jax.hmasd.rollout_phase import (
    Rollout,
    RolloutMemory,
    collect,
    init_rollout_memory,
)
from hmasd_jax.networks.actor_critic import SequenceBatch
from hmasd_jax.rl import rollout as rollouts
from hmasd_jax.rl.averaging import averaged_params
from hmasd_jax.rl.keys import key_beside
from hmasd_jax.rl.sgd import LossFn, gradient_step, ppo_epochs, scale_steps, sgd_epochs
from hmasd_jax.rl.value_norm import ValueNorm
from hmasd_jax.types import Algorithm, EnvCarry, Key, Learner, Metrics, Policy


class HMASDState(NamedTuple):
    """State of training: everything that the next update depends on."""

    key: Key
    num_updates: Int[Array, ""]
    env: EnvCarry
    memory: RolloutMemory
    coordinator: Learner
    discoverer: Learner
    discriminators: Learner
    coordinator_norm: ValueNorm
    discoverer_norm: ValueNorm
    distance: Any = ()
    bonus: Any = ()
    successes: Any = ()


def make_hmasd(env: Environment, config: HMASDConfig) -> Algorithm:
    """Build HMASD for `env`.

    Raises:
        ConfigError: `discriminator_obs` names a feature that obs does not have.
    """
    parts = make_parts(env, config)

    def init(key: Key) -> HMASDState:
        return init_state(parts, key)

    def update(state: HMASDState) -> tuple[HMASDState, Metrics]:
        return train_iteration(parts, state)

    def policy(
        state: HMASDState,
        greedy: bool = True,
        skills: Sequence[int | None] | None = None,
        allowed: Bool[Array, "tokens skills"] | None = None,
    ) -> Policy:
        params = averaged_params(state.coordinator), averaged_params(state.discoverer)
        return make_policy(parts, *params, greedy, skills, allowed)

    return Algorithm(init, update, policy)


def init_state(parts: Parts, key: Key) -> HMASDState:
    """Algorithm 1, "Initialize": fresh networks, and E copies at the start of an episode."""
    key, key_learners, key_env = jax.random.split(key, 3)
    ppo = parts.config.ppo
    coordinator, discoverer, discriminators = init_learners(parts, key_learners)
    key_distance, key_bonus = jax.random.split(key_beside(key, 0))
    return HMASDState(
        key=key,
        num_updates=jnp.int32(0),
        env=rollouts.reset(parts.env, key_env, ppo.num_envs),
        memory=init_rollout_memory(ppo.num_envs, parts.env.num_agents, ppo.hidden_size),
        coordinator=coordinator,
        discoverer=discoverer,
        discriminators=discriminators,
        coordinator_norm=ValueNorm.create(),
        discoverer_norm=ValueNorm.create(),
        distance=parts.distance.init(key_distance),
        bonus=parts.bonus.init(key_bonus),
        successes=parts.imitation.init(),
    )


def train_iteration(parts: Parts, state: HMASDState) -> tuple[HMASDState, Metrics]:
    """Algorithm 1, one turn of the outer loop: one rollout, then all three trainings.

    The order is the authors': both returns, coordinator, discoverer, discriminators. Intrinsic
    rewards come from the discriminators of the rollout, before they are trained on it.
    """
    key, key_collect, key_choose, key_high, key_low, key_pairs = jax.random.split(state.key, 6)
    rollout = collect(
        parts, state.coordinator.params, state.discoverer.params, state.env, state.memory,
        key_collect, random_share(parts, state.bonus),
    )  # fmt: skip
    key_noise, key_pairs = jax.random.split(key_pairs)
    # One sample per step, the shape they are trained on, so that the networks compile once.
    pairs = rollouts.flatten(observe(skill_pairs(parts, rollout), parts.config, key_noise))
    pairs = pairs._replace(weight=sample_weight(parts, state.bonus, pairs.skills))
    log_q_team, log_q_individual, q_metrics = log_q_of_skills(
        state.discriminators.params, parts.discriminators, pairs
    )
    unknown = unknown_share(log_q_individual, pairs.weight, parts.config.num_skills)
    bonus_state, reward, bonus_metrics = all_rewards(
        parts, state, rollout, log_q_team, log_q_individual, unknown, key_beside(key, 1)
    )
    high = high_batch(parts, state.coordinator.params, state.coordinator_norm, rollout, key_choose)
    low = low_batch(parts, state.discoverer.params, state.discoverer_norm, rollout, reward)

    coordinator, coordinator_norm, high_metrics = train_coordinator(parts, state, high, key_high)
    discoverer, discoverer_norm, low_metrics = train_discoverer(parts, state, low, key_low, unknown)
    discriminators, d_metrics = train_discriminators(parts, state, pairs, key_pairs)
    discoverer, explored, explore_metrics = train_exploration(
        parts, state, rollout, low, discoverer, key
    )
    metrics = {
        **rollouts.rollout_metrics(rollout.transitions.outcome),
        "low_reward": reward.mean(),
        **{f"discriminators/{k}": v for k, v in (q_metrics | d_metrics).items()},
        **{f"coordinator/{k}": v for k, v in high_metrics.items()},
        **{f"discoverer/{k}": v for k, v in low_metrics.items()},
        **{f"exploration/{k}": v for k, v in (bonus_metrics | explore_metrics).items()},
    }
    next_state = HMASDState(
        key=key,
        num_updates=state.num_updates + 1,
        env=rollout.env,
        memory=rollout.memory,
        coordinator=coordinator,
        discoverer=discoverer,
        discriminators=discriminators,
        coordinator_norm=coordinator_norm,
        discoverer_norm=discoverer_norm,
        bonus=bonus_state,
        **explored,
    )
    return next_state, metrics


def all_rewards(
    parts: Parts,
    state: HMASDState,
    rollout: Rollout,
    log_q_team: Float[Array, " B"],
    log_q_individual: Float[Array, "B N"],
    unknown: Float[Array, ""],
    key: Key,
) -> tuple[Any, Float[Array, "T E N"], Metrics]:
    """Return the next state of the bonus, the rewards of the low level, and metrics.

    The rewards are Eq. 4, distance along the skills, and the bonus. B counts the T * E steps, and
    `unknown` is what q_d does not know.
    """
    outcome = rollout.transitions.outcome
    weight = skill_weight(parts, state.bonus, outcome.reward, unknown)
    reward = low_level_reward(
        outcome.reward.reshape(-1), log_q_team, log_q_individual, parts.config, weight
    ).reshape(*outcome.reward.shape, -1)
    team, individual, metrics = parts.distance.reward(state.distance, skill_steps(rollout))
    bonus_state, bonus, bonus_metrics = parts.bonus.update(state.bonus, outcome, key)
    distance = weight * (individual + team[:, None]).reshape(*bonus.shape, -1)
    return bonus_state, reward + (distance + bonus[..., None]), metrics | bonus_metrics


def train_coordinator(
    parts: Parts, state: HMASDState, batch: HighBatch, key: Key
) -> tuple[Learner, ValueNorm, Metrics]:
    """Train on Eq. 6 for the configured epochs."""
    optimizer, loss_fn = coordinator_objective(parts, state.bonus)
    return ppo_epochs(
        optimizer, loss_fn, state.coordinator, state.coordinator_norm,
        batch, key, parts.config.ppo,
    )  # fmt: skip


def coordinator_objective(
    parts: Parts, bonus_state: Any
) -> tuple[optax.GradientTransformation, LossFn]:
    """Return the optimizer and the loss of Eq. 6, with the coefficients of one update."""
    entropy_coef = high_entropy_coef(parts, bonus_state)

    def loss_fn(params, norm, batch):
        return coordinator_loss(params, parts.coordinator, norm, batch, parts.config, entropy_coef)

    factor = coordinator_step_factor(parts, bonus_state)
    return scale_steps(parts.coordinator_optimizer, factor), loss_fn


def train_discoverer(
    parts: Parts,
    state: HMASDState,
    batch: SequenceBatch,
    key: Key,
    unknown: float | Float[Array, ""] = 0.0,
) -> tuple[Learner, ValueNorm, Metrics]:
    """Train on Eq. 7 for the configured epochs. `unknown` is what q_d does not know."""
    entropy_coef = low_entropy_coef(parts, state.bonus, state.num_updates, unknown)

    def loss_fn(params, norm, batch):
        return discoverer_loss(params, parts.discoverer, norm, batch, parts.config, entropy_coef)

    return ppo_epochs(
        discoverer_optimizer(parts, state), loss_fn, state.discoverer, state.discoverer_norm,
        batch, key, parts.config.ppo,
    )  # fmt: skip


def discoverer_optimizer(parts: Parts, state: HMASDState) -> optax.GradientTransformation:
    """Return the optimizer of Eq. 7 and of imitation, with the step sizes of one update."""
    factor = step_factor(parts.bonus, state.bonus, parts.config)
    return scale_steps(parts.discoverer_optimizer, factor)


def train_discriminators(
    parts: Parts, state: HMASDState, pairs: SkillPair, key: Key
) -> tuple[Learner, Metrics]:
    """Train on Eq. 8 for the configured epochs, on the whole rollout each."""

    def step(learner, pairs):
        return gradient_step(
            learner, parts.discriminator_optimizer, discriminator_loss, parts.discriminators, pairs
        )

    epochs = parts.config.discriminator_epochs
    return sgd_epochs(step, state.discriminators, pairs, key, epochs, 1)


def train_exploration(
    parts: Parts,
    state: HMASDState,
    rollout: Rollout,
    batch: SequenceBatch,
    discoverer: Learner,
    key: Key,
) -> tuple[Learner, dict[str, Any], Metrics]:
    """Train the parts beside the paper: distance and imitation, which may both be absent.

    Args:
        parts: static components.
        state: state before the update.
        rollout: rollout to learn from.
        batch: B_l of the rollout.
        discoverer: discoverer after Eq. 7, which imitation trains further.
        key: key of the next state. Draws here use keys beside those of its split, so that the
            draws of the paper's parts stay as they are.

    Returns:
        The discoverer, the new fields of the state by name, and metrics.
    """
    key_store, key_distance = jax.random.split(key_beside(key, 0))
    distance, distance_metrics = parts.distance.train(
        state.distance, skill_steps(rollout), key_distance
    )
    successes, store_metrics = parts.imitation.store(
        state.successes, batch, rollout.transitions, key_store
    )
    optimizer = discoverer_optimizer(parts, state)
    discoverer, imitation_metrics = parts.imitation.train(successes, discoverer, optimizer)
    fields = {"distance": distance, "successes": successes}
    return discoverer, fields, distance_metrics | store_metrics | imitation_metrics
