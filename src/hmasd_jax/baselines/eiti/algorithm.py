"""EITI and EDTI (Wang et al., ICLR 2020): agents that learn alone and explore together.

Each agent is a PPO learner of its own, that of IPPO, and shares nothing with the others. Its reward
is the team's, plus a curiosity bonus for local states that it has rarely visited, plus a reward for
influence on the other agents. Everything but the last is the same in both algorithms.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jaxtyping import Array, Int

from envs_jax import Environment
from hmasd_jax.baselines.eiti import counts, tables
from hmasd_jax.baselines.eiti.config import EDTIConfig, EITIConfig, InfluenceConfig
from hmasd_jax.baselines.eiti.interaction import Interaction, make_edti_reward, make_eiti_reward
from hmasd_jax.baselines.eiti.tables import Table
from hmasd_jax.baselines.ippo import IPPOConfig
from hmasd_jax.baselines.mappo import algorithm as mappo
from hmasd_jax.baselines.mappo import components
from hmasd_jax.networks.actor_critic import ActorCritic, ActorCriticMemory, SequenceBatch
from hmasd_jax.networks.recurrent import SMALL_GAIN, FeedForwardNet, RecurrentNet
from hmasd_jax.rl import rollout as rollouts
from hmasd_jax.rl.gae import normalize_advantage
from hmasd_jax.rl.sgd import ppo_epochs
from hmasd_jax.rl.value_norm import ValueNorm
from hmasd_jax.types import Algorithm, EnvCarry, Key, Learner, Metrics
from hmasd_jax.validation import ConfigError


class InfluenceState(NamedTuple):
    """State of training: everything that the next update depends on."""

    key: Key
    num_updates: Int[Array, ""]
    env: EnvCarry
    memory: ActorCriticMemory
    learner: Learner
    """All arrays begin with the axis N."""
    norm: ValueNorm
    """(N,)."""
    table: Table
    interaction: Any


@dataclass(frozen=True)
class Parts:
    """Static components that the pure functions take."""

    env: Environment
    config: InfluenceConfig
    one: components.Parts
    """IPPO of a single agent, which learns."""
    each: components.Parts
    """The same with an axis of agents in parameters and inputs, which acts."""
    interaction: Interaction


def make_eiti(env: Environment, config: EITIConfig) -> Algorithm:
    """Build EITI for `env`."""
    return make_algorithm(env, config, *make_learners(env, config), make_eiti_reward(config))


def make_edti(env: Environment, config: EDTIConfig) -> Algorithm:
    """Build EDTI for `env`."""
    one, each = make_learners(env, config)
    interaction = make_edti_reward(config, one.networks, each.networks)
    return make_algorithm(env, config, one, each, interaction)


def make_algorithm(
    env: Environment,
    config: InfluenceConfig,
    one: components.Parts,
    each: components.Parts,
    interaction: Interaction,
) -> Algorithm:
    """Build an algorithm from learners and a reward for influence."""
    parts = Parts(env, config, one, each, interaction)
    return Algorithm(
        partial(init_state, parts),
        partial(train_iteration, parts),
        partial(mappo.make_policy, each),
    )


def make_learners(
    env: Environment, config: InfluenceConfig
) -> tuple[components.Parts, components.Parts]:
    """Build IPPO of a single agent, and of all agents without shared weights.

    Raises:
        ConfigError: Agents cannot influence each other, or have fewer features than are named.
    """
    if env.num_agents < 2:
        raise ConfigError(
            f"algorithm.name eiti and edti reward influence on other agents, but env has "
            f"{env.num_agents} agent: choose ippo"
        )
    last = max(config.local_state.features, default=0)
    if last >= env.obs_dim:
        raise ConfigError(
            f"algorithm.local_state.features has index {last}, but obs has {env.obs_dim} features "
            f"(0 to {env.obs_dim - 1}): leave it out"
        )
    ippo = IPPOConfig(entropy_coef=config.entropy_coef, recurrent=config.recurrent, ppo=config.ppo)
    one = components.make_parts(env, ippo)
    net = nn.vmap(
        RecurrentNet if config.recurrent else FeedForwardNet,
        variable_axes={"params": 0}, split_rngs={"params": True},
        in_axes=(-2, -2, -1, None), out_axes=-2,  # of memory, x, first, skill
    )  # fmt: skip
    size = config.ppo.hidden_size
    networks = ActorCritic(
        actor=net(env.num_actions, size, gain=SMALL_GAIN), critic=net(1, size, gain=1.0)
    )
    optimizer = optax.GradientTransformationExtraArgs(
        jax.vmap(one.optimizer.init), jax.vmap(one.optimizer.update)
    )
    return one, replace(one, networks=networks, optimizer=optimizer)


def init_state(parts: Parts, key: Key) -> InfluenceState:
    """Initialize the learners, empty counts, and E copies at the start of an episode."""
    key_ippo, key_interaction = jax.random.split(key)
    ippo = mappo.init_state(parts.each, key_ippo)
    zeros = jnp.zeros(parts.env.num_agents)
    return InfluenceState(
        key=ippo.key,
        num_updates=ippo.num_updates,
        env=ippo.env,
        memory=ippo.memory,
        learner=ippo.learner,
        norm=ValueNorm(zeros, zeros, zeros),
        table=tables.init(parts.config.local_state.table_size),
        interaction=parts.interaction.init(ippo.env, key_interaction),
    )


def split_agents(batch: SequenceBatch) -> SequenceBatch:
    """Return a batch for each agent, as if it were alone: (S, L, N, ...) -> (N, S, L, 1, ...)."""

    def split(axis, x):
        return jnp.expand_dims(jnp.moveaxis(x, axis, 0), axis + 1)

    num_agents = batch.action.shape[-1]
    by_step = {
        name: split(2, x)
        for name, x in batch._asdict().items()
        if name not in ("memory", "first", "skills")
    }
    return batch._replace(
        memory=jax.tree.map(partial(split, 1), batch.memory),
        first=jnp.broadcast_to(batch.first, (num_agents, *batch.first.shape)),
        **by_step,
    )


def train_iteration(parts: Parts, state: InfluenceState) -> tuple[InfluenceState, Metrics]:
    """Do one rollout, count its transitions, and let every agent learn from it."""
    key, key_rollout, key_epochs, key_interaction = jax.random.split(state.key, 4)
    config, ppo = parts.config, parts.config.ppo
    env, memory, transitions = rollouts.unroll(
        parts.env, mappo.act_and_evaluate(parts.each, state.learner.params),
        state.env, state.memory, key_rollout, ppo.rollout_length,
    )  # fmt: skip
    keys = counts.make_keys(transitions, config.local_state)
    table, explored = counts.count(state.table, keys)
    curiosity = config.curiosity_coef * explored.novelty
    shared, kept = parts.interaction.reward(state.interaction, transitions, env, explored)
    reward = transitions.outcome.reward[..., None] + curiosity + shared
    batch = mappo.make_batch(
        parts.each, state, transitions, env, memory.critic, reward,
        jax.vmap(normalize_advantage, in_axes=-1, out_axes=-1),
    )  # fmt: skip
    learner, norm, metrics = _learn(parts, state, batch, key_epochs)
    interaction, more_metrics = parts.interaction.train(
        state.interaction, kept, transitions, key_interaction
    )
    next_state = InfluenceState(
        key=key,
        num_updates=state.num_updates + 1,
        env=env,
        memory=memory,
        learner=learner,
        norm=norm,
        table=table,
        interaction=interaction,
    )
    metrics |= more_metrics | {
        "exploration/curiosity_reward": curiosity.mean(),
        "exploration/influence": explored.influence.sum(-1).mean(),
        "exploration/influence_reward": shared.mean(),
        "exploration/table_load": tables.load(table),
    }
    return next_state, metrics | rollouts.rollout_metrics(transitions.outcome)


def _learn(
    parts: Parts, state: InfluenceState, batch: SequenceBatch, key: Key
) -> tuple[Learner, ValueNorm, Metrics]:
    """Run the epochs of PPO for each agent by itself. Metrics are means over agents."""

    def learn(learner, norm, batch):
        loss = partial(mappo.mappo_loss, parts.one)
        return ppo_epochs(parts.one.optimizer, loss, learner, norm, batch, key, parts.config.ppo)

    learner, norm, metrics = jax.vmap(learn)(state.learner, state.norm, split_agents(batch))
    return learner, norm, jax.tree.map(jnp.mean, metrics)
