"""Rewards for influence on other agents: influence itself in EITI, what it is worth in EDTI."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from hmasd_jax.baselines.eiti import critics
from hmasd_jax.baselines.eiti.config import EDTIConfig, EITIConfig
from hmasd_jax.baselines.eiti.counts import Explored
from hmasd_jax.baselines.eiti.critics import CriticParts, Critics, Evaluated
from hmasd_jax.networks.actor_critic import ActorCritic
from hmasd_jax.rl.sgd import make_optimizer
from hmasd_jax.types import EnvCarry, Key, Metrics, Transition


class Interaction(NamedTuple):
    """A reward for influence as three pure functions."""

    init: Callable[[EnvCarry, Key], Any]
    """`init(env, key)`: state before the first rollout."""
    reward: Callable[..., tuple[Float[Array, "T E N"], Any]]
    """`reward(state, transitions, env, explored)`: the reward, and what `train` needs. `env` are
    the copies after the rollout."""
    train: Callable[[Any, Any, Transition, Key], tuple[Any, Metrics]]
    """`train(state, kept, transitions, key)`: learn from a rollout."""


def make_eiti_reward(config: EITIConfig) -> Interaction:
    """Build r^i = beta_T sum_j b(i, j), the reward of EITI."""

    def reward(state, transitions: Transition, env: EnvCarry, explored: Explored):
        del state, transitions, env
        return config.influence_coef * explored.influence.sum(-1), ()

    return Interaction(
        init=lambda env, key: (),
        reward=reward,
        train=lambda state, kept, transitions, key: (state, {}),
    )


def make_edti_reward(config: EDTIConfig, one: ActorCritic, each: ActorCritic) -> Interaction:
    """Build the reward of EDTI, `edti_reward`, and the critics that it needs.

    Args:
        config: settings.
        one: networks of a single agent.
        each: the same with an axis of agents in parameters and inputs.
    """
    parts = CriticParts(config.ppo, one, each, make_optimizer(config.ppo, ["critic"]))

    def reward(state: Critics, transitions: Transition, env: EnvCarry, explored: Explored):
        evaluated = critics.evaluate(parts, state, transitions, env)
        streams = streams_of_reward(config, transitions, explored)
        after = evaluated.after.reshape(streams.shape)
        return edti_reward(config, streams, after, explored.influence), (evaluated, streams)

    def train(
        state: Critics, kept: tuple[Evaluated, Array], transitions: Transition, key: Key
    ) -> tuple[Critics, Metrics]:
        evaluated, streams = kept
        by_critic = streams.reshape(evaluated.value.shape)
        return critics.train(parts, state, evaluated, transitions, by_critic, key)

    return Interaction(partial(critics.init, parts), reward, train)


def streams_of_reward(
    config: EDTIConfig, transitions: Transition, explored: Explored
) -> Float[Array, "T E N streams"]:
    """Return the team reward and the curiosity bonus of each agent."""
    curiosity = config.curiosity_coef * explored.novelty
    team_reward = jnp.broadcast_to(transitions.outcome.reward[..., None], curiosity.shape)
    return jnp.stack([team_reward, curiosity], axis=-1)


def edti_reward(
    config: EDTIConfig,
    streams: Float[Array, "T E N streams"],
    after: Float[Array, "T E N streams"],
    influence: Float[Array, "T E N N"],
) -> Float[Array, "T E N"]:
    """Return r^i = sum_j c . r^j + gamma sum_j b(i, j) beta . V^j, j being the other agents.

    r^j are the streams of agent j, its team reward and curiosity bonus, c their weights, V^j the
    values of what the step led to, and beta the weights of these.
    """
    others = jnp.array([config.others_reward_coef, config.others_curiosity_coef])
    values = jnp.array([config.reward_value_coef, config.curiosity_value_coef])
    of_agent = streams @ others
    of_others = of_agent.sum(-1, keepdims=True) - of_agent
    worth = jnp.einsum("teij,tej->tei", influence, after @ values)
    return of_others + config.ppo.discount * worth
