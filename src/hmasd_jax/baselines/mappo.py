"""MAPPO (Yu et al., NeurIPS 2022): PPO, one actor for all agents, a centralized critic.

Behaves as on-policy's `r_mappo`. Values have an axis V on their last place: one value of the state
for all agents, or one per agent (`MAPPOConfig.critic_input`).
"""

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from envs_jax import Environment, TimeStep
from hmasd_jax.networks.actor_critic import (
    ActorCritic,
    ActorCriticMemory,
    action_distribution,
    agents_loss,
    state_value,
)
from hmasd_jax.networks.recurrent import FeedForwardNet, RecurrentNet
from hmasd_jax.networks.transformer import SMALL_GAIN
from hmasd_jax.rl import rollout as rollouts
from hmasd_jax.rl.gae import normalize_advantage, rollout_advantage
from hmasd_jax.rl.ppo import PPOConfig, has_choice
from hmasd_jax.rl.sgd import make_optimizer, ppo_epochs
from hmasd_jax.rl.value_norm import ValueNorm
from hmasd_jax.types import Algorithm, EnvCarry, Key, Learner, Metrics, Policy, StepFn, Transition
from hmasd_jax.validation import check_range

if TYPE_CHECKING:
    from distrax import Categorical


@dataclass(frozen=True)
class MAPPOConfig:
    """MAPPO on one task; the defaults are the paper's, on-policy's `rmappo`."""

    entropy_coef: float = 0.01
    """Weight of the policy's entropy."""
    recurrent: bool = True
    """Whether actor and critic have a memory (on-policy's `rmappo`) or not (its `mappo`)."""
    critic_input: Literal["state", "agent"] = "state"
    """What the critic sees: the global `state`, once for all agents, or, for a value per `agent`,
    the state, the agent's observation and its index."""
    death_masking: bool = True
    """With `critic_input` "agent": whether the critic sees nothing but the index of an agent that
    has no choice of actions, as the dead."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Optimization settings."""

    def __post_init__(self) -> None:
        check_range(self, "entropy_coef", low=0)


class MAPPOState(NamedTuple):
    """Everything that training goes on from."""

    key: Key
    num_updates: Int[Array, ""]
    env: EnvCarry
    memory: ActorCriticMemory
    learner: Learner
    norm: ValueNorm


class Extras(NamedTuple):
    """What the update needs to know about a step."""

    memory: ActorCriticMemory
    """Before the step."""
    log_prob: Float[Array, "*T E N"]
    value: Float[Array, "*T E V"]
    """In normalized units."""


class Batch(NamedTuple):
    """Sequences of L consecutive steps of one environment copy, sample axis first."""

    memory: ActorCriticMemory
    """Before the first step, as it was when acting: (S, ...) without L."""
    first: Bool[Array, "S L"]
    obs: Float[Array, "S L N obs"]
    state: Float[Array, "S L V state"]
    """What the critic sees."""
    action_mask: Bool[Array, "S L N actions"]
    action: Int[Array, "S L N"]
    log_prob: Float[Array, "S L N"]
    value: Float[Array, "S L V"]
    advantage: Float[Array, "S L N"]
    target: Float[Array, "S L V"]
    """Returns in reward units."""


@dataclass(frozen=True)
class Parts:
    """What the pure functions of MAPPO close over."""

    env: Environment
    config: MAPPOConfig
    networks: ActorCritic
    optimizer: optax.GradientTransformation

    @property
    def num_values(self) -> int:
        """V."""
        return 1 if self.config.critic_input == "state" else self.env.num_agents


def make_mappo(env: Environment, config: MAPPOConfig) -> Algorithm:
    """Build MAPPO for `env`."""
    parts = make_parts(env, config)
    return Algorithm(
        partial(init_state, parts), partial(train_iteration, parts), partial(make_policy, parts)
    )


def make_parts(env: Environment, config: MAPPOConfig) -> Parts:
    """Networks and optimizer; actor and critic share nothing, and are clipped apart."""
    net = RecurrentNet if config.recurrent else FeedForwardNet
    size = config.ppo.hidden_size
    networks = ActorCritic(
        actor=net(env.num_actions, size, gain=SMALL_GAIN), critic=net(1, size, gain=1.0)
    )
    return Parts(env, config, networks, make_optimizer(config.ppo, ActorCritic._fields))


def init_state(parts: Parts, key: Key) -> MAPPOState:
    """Fresh networks, and E copies at the start of an episode."""
    key, key_env, key_actor, key_critic = jax.random.split(key, 4)
    ppo = parts.config.ppo
    env = rollouts.reset(parts.env, key_env, ppo.num_envs)
    memory = init_memory(parts, (ppo.num_envs,))
    obs, state = env.timestep.obs[None], critic_input(parts.config, env.timestep)[None]
    actor, critic = parts.networks
    params = {
        "actor": actor.init(key_actor, memory.actor, obs, jnp.ones(obs.shape[:-1], bool)),
        "critic": critic.init(key_critic, memory.critic, state, jnp.ones(state.shape[:-1], bool)),
    }
    learner = Learner(params, parts.optimizer.init(params))
    return MAPPOState(key, jnp.int32(0), env, memory, learner, ValueNorm.create())


def init_memory(parts: Parts, batch_shape: tuple[int, ...]) -> ActorCriticMemory:
    """Memory before the first step."""
    size = parts.config.ppo.hidden_size
    return ActorCriticMemory(
        jnp.zeros((*batch_shape, parts.env.num_agents, size)),
        jnp.zeros((*batch_shape, parts.num_values, size)),
    )


def critic_input(config: MAPPOConfig, timestep: TimeStep) -> Float[Array, "*batch V state"]:
    """What each value depends on."""
    state, obs = timestep.state[..., None, :], timestep.obs
    if config.critic_input == "state":
        return state
    state = jnp.broadcast_to(state, (*obs.shape[:-1], state.shape[-1]))
    seen = jnp.concatenate([state, obs], axis=-1)
    if config.death_masking:
        seen = jnp.where(has_choice(timestep.action_mask)[..., None], seen, 0.0)
    num_agents = obs.shape[-2]
    index = jnp.broadcast_to(jnp.eye(num_agents), (*obs.shape[:-1], num_agents))
    return jnp.concatenate([seen, index], axis=-1)


def make_policy(parts: Parts, state: MAPPOState, greedy: bool = True) -> Policy:
    """Execution: the actor alone."""

    def init(batch_shape: tuple[int, ...] = ()) -> Float[Array, "*batch N hidden"]:
        return init_memory(parts, batch_shape).actor

    def step(memory, timestep, first, key):
        memory, distribution = act(parts, state.learner.params, memory, timestep, first)
        action = distribution.mode() if greedy else distribution.sample(seed=key)
        return memory, action, ()

    return Policy(init, step)


def act_and_evaluate(parts: Parts, params: dict) -> StepFn:
    """Sample actions and evaluate what is seen, in training."""

    def step(memory, timestep, first, key):
        actor, distribution = act(parts, params, memory.actor, timestep, first)
        critic, value = evaluate(parts, params, memory.critic, timestep, first)
        action = distribution.sample(seed=key)
        log_prob = jnp.asarray(distribution.log_prob(action))
        return ActorCriticMemory(actor, critic), action, Extras(memory, log_prob, value)

    return step


def act(
    parts: Parts, params: dict, memory: Array, timestep: TimeStep, first: Bool[Array, "*batch"]
) -> tuple[Float[Array, "*batch N hidden"], "Categorical"]:
    """The actor's memory and pi(a^i|o^i) at a single step, at any leading axes."""
    memory, distribution = action_distribution(
        parts.networks.actor, params["actor"], memory,
        timestep.obs[None], timestep.action_mask[None], first[None],
    )  # fmt: skip
    return memory, distribution[0]


def evaluate(
    parts: Parts, params: dict, memory: Array, timestep: TimeStep, first: Bool[Array, "*batch"]
) -> tuple[Float[Array, "*batch V hidden"], Float[Array, "*batch V"]]:
    """The critic's memory and values of a single step, at any leading axes."""
    state = critic_input(parts.config, timestep)
    first = jnp.broadcast_to(first[..., None], state.shape[:-1])
    memory, value = state_value(
        parts.networks.critic, params["critic"], memory, state[None], first[None]
    )
    return memory, value[0]


def make_batch(
    parts: Parts, state: MAPPOState, transitions: Transition, env: EnvCarry, memory: Array
) -> Batch:
    """Advantages and targets over a rollout, then sequences of `sequence_length` steps.

    Args:
        parts: networks and settings.
        state: parameters and value normalizer during the rollout.
        transitions: (T, E, ...), with `Extras`.
        env: where the copies stand after the last step.
        memory: of the critic, after the last step.
    """
    params, extras, outcome = state.learner.params, transitions.extras, transitions.outcome
    timestep, ppo = transitions.timestep, parts.config.ppo
    _, last_value = evaluate(parts, params, memory, env.timestep, env.first)

    def value_of_outcome():
        after = rollouts.following(extras.memory.critic, memory)
        return evaluate(parts, params, after, outcome, jnp.zeros_like(outcome.done))[1]

    advantage, target = rollout_advantage(
        outcome.reward[..., None], extras.value, last_value, outcome, value_of_outcome,
        state.norm, ppo,
    )  # fmt: skip
    advantage = jnp.broadcast_to(advantage, transitions.action.shape)
    begin = jax.tree.map(lambda x: x[:: ppo.sequence_length], extras.memory)
    steps = {
        "first": transitions.first,
        "obs": timestep.obs,
        "state": critic_input(parts.config, timestep),
        "action_mask": timestep.action_mask,
        "action": transitions.action,
        "log_prob": extras.log_prob,
        "value": extras.value,
        "advantage": normalize_advantage(advantage, has_choice(timestep.action_mask)),
        "target": target,
    }
    return Batch(rollouts.flatten(begin), **rollouts.cut(steps, ppo.sequence_length))


def mappo_loss(
    params: dict, parts: Parts, norm: ValueNorm, batch: Batch
) -> tuple[Float[Array, ""], Metrics]:
    """Clipped policy loss and entropy of the agents that have a choice, clipped value loss of all.

    All are means. On-policy's two losses and optimizers are one of each here: as nothing is shared
    and each network is clipped by its own norm, the steps are the same.
    """
    # (S, L, ...) -> (L, S, ...): recurrent networks run over the first axis.
    batch = Batch(batch.memory, *(x.swapaxes(0, 1) for x in batch[1:]))
    _, distribution = action_distribution(
        parts.networks.actor, params["actor"], batch.memory.actor,
        batch.obs, batch.action_mask, batch.first,
    )  # fmt: skip
    first = jnp.broadcast_to(batch.first[..., None], batch.value.shape)
    _, value = state_value(
        parts.networks.critic, params["critic"], batch.memory.critic, batch.state, first
    )
    config = parts.config
    return agents_loss(distribution, value, batch, norm, config.ppo, config.entropy_coef)


def train_iteration(parts: Parts, state: MAPPOState) -> tuple[MAPPOState, Metrics]:
    """One rollout and all learning from it."""
    key, key_rollout, key_epochs = jax.random.split(state.key, 3)
    ppo = parts.config.ppo
    env, memory, transitions = rollouts.unroll(
        parts.env, act_and_evaluate(parts, state.learner.params),
        state.env, state.memory, key_rollout, ppo.rollout_length,
    )  # fmt: skip
    batch = make_batch(parts, state, transitions, env, memory.critic)

    def loss_fn(params, norm, batch):
        return mappo_loss(params, parts, norm, batch)

    learner, norm, metrics = ppo_epochs(
        parts.optimizer, loss_fn, state.learner, state.norm, batch, key_epochs, ppo
    )
    metrics |= rollouts.episode_metrics(transitions.outcome)
    metrics |= {"team_reward": transitions.outcome.reward.mean()}
    return MAPPOState(key, state.num_updates + 1, env, memory, learner, norm), metrics
