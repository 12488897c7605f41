"""MAPPO (Yu et al., NeurIPS 2022): PPO, one actor for all agents, a centralized critic.

The behavior is that of on-policy's `r_mappo`. The last axis of values is V: one value of the state
for all agents, or one per agent (`MAPPOConfig.critic_input`).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from envs_jax import Environment
from hmasd_jax.baselines.mappo.components import (
    Extras,
    MAPPOConfig,
    Parts,
    critic_input,
    init_memory,
    make_parts,
)
from hmasd_jax.exploration.greedy_copies import mark_greedy, normalize_and_blame, per_agent
from hmasd_jax.exploration.solved import actions_entropy_coef, step_factor
from hmasd_jax.networks.actor_critic import (
    ActorCriticMemory,
    SequenceBatch,
    sequence_loss,
    sequences,
)
from hmasd_jax.rl import rollout as rollouts
from hmasd_jax.rl.averaging import averaged_params
from hmasd_jax.rl.categorical import choose
from hmasd_jax.rl.gae import normalize_advantage, rollout_advantage
from hmasd_jax.rl.keys import key_beside
from hmasd_jax.rl.sgd import ppo_epochs, scale_steps
from hmasd_jax.rl.value_norm import ValueNorm
from hmasd_jax.types import Algorithm, EnvCarry, Key, Learner, Metrics, Policy, StepFn, Transition


class MAPPOState(NamedTuple):
    """State of training: everything that the next update depends on."""

    key: Key
    num_updates: Int[Array, ""]
    env: EnvCarry
    memory: ActorCriticMemory
    learner: Learner
    norm: ValueNorm
    bonus: Any = ()
    successes: Any = ()


@runtime_checkable
class Learned(Protocol):
    """State of training, as far as acting and evaluating need it."""

    @property
    def learner(self) -> Learner:
        """Parameters of actor and critic."""
        ...

    @property
    def norm(self) -> ValueNorm:
        """Units of the critic."""
        ...


def make_mappo(env: Environment, config: MAPPOConfig) -> Algorithm:
    """Build MAPPO for `env`."""
    parts = make_parts(env, config)
    return Algorithm(
        partial(init_state, parts), partial(train_iteration, parts), partial(make_policy, parts)
    )


def init_state(parts: Parts, key: Key) -> MAPPOState:
    """Initialize the networks, and E copies at the start of an episode."""
    key, key_env, key_actor, key_critic = jax.random.split(key, 4)
    ppo = parts.config.ppo
    env = rollouts.reset(parts.env, key_env, ppo.num_envs)
    memory = init_memory(parts, (ppo.num_envs,))
    obs, state = env.timestep.obs[None], critic_input(parts.config, env.timestep)[None]
    actor, critic = parts.networks.actor, parts.networks.critic
    params = {
        "actor": actor.init(key_actor, memory.actor, obs, jnp.ones(obs.shape[:-1], bool), None),
        "critic": critic.init(
            key_critic, memory.critic, state, jnp.ones(state.shape[:-1], bool), None
        ),
    }
    learner = Learner(params, parts.optimizer.init(params))
    return MAPPOState(
        key=key,
        num_updates=jnp.int32(0),
        env=env,
        memory=memory,
        learner=learner,
        norm=ValueNorm.create(),
        bonus=parts.bonus.init(key_beside(key, 0)),
        successes=parts.imitation.init(),
    )


def make_policy(parts: Parts, state: Learned, greedy: bool = True) -> Policy:
    """Build the policy for execution, which needs the actor alone."""
    params = averaged_params(state.learner)

    def init(batch_shape: tuple[int, ...] = ()) -> Float[Array, "*batch N hidden"]:
        return init_memory(parts, batch_shape).actor

    def step(memory, timestep, first, key):
        memory, distribution = parts.networks.act(
            params, memory, timestep.obs, timestep.action_mask, first
        )
        action = choose(distribution, greedy, key)
        return memory, action, ()

    return Policy(init, step)


def act_and_evaluate(parts: Parts, params: dict) -> StepFn:
    """Build a step that samples actions and evaluates the critic, for training."""
    greedy = mark_greedy(parts.config)

    def step(memory, timestep, first, key):
        actor, distribution = parts.networks.act(
            params, memory.actor, timestep.obs, timestep.action_mask, first
        )
        state = critic_input(parts.config, timestep)
        critic, value = parts.networks.value(params, memory.critic, state, first)
        action = choose(distribution, per_agent(greedy), key)
        log_prob = jnp.asarray(distribution.log_prob(action))
        extras = Extras(memory=memory, log_prob=log_prob, value=value)
        return ActorCriticMemory(actor=actor, critic=critic), action, extras

    return step


def make_batch(
    parts: Parts,
    state: Learned,
    transitions: Transition,
    env: EnvCarry,
    memory: Array,
    reward: Float[Array, "T E #N"],
    normalize: Callable[[Array, Array], Array] = normalize_advantage,
) -> SequenceBatch:
    """Compute advantages and targets of a rollout, and cut it into sequences of L steps.

    Args:
        parts: networks and settings.
        state: parameters and value normalizer during the rollout.
        transitions: (T, E, ...), with `Extras`.
        env: the copies after the last step.
        memory: memory of the critic after the last step.
        reward: rewards of the agents or of the team, with any exploration bonus.
        normalize: function of the advantages (T, E, N), and of whether each agent has a choice.
    """
    params, extras, outcome = state.learner.params, transitions.extras, transitions.outcome
    timestep, config = transitions.timestep, parts.config
    seen = critic_input(config, env.timestep)
    _, last_value = parts.networks.value(params, memory, seen, env.first)

    def value_of_outcome():
        after = rollouts.following(extras.memory.critic, memory)
        never = jnp.zeros_like(outcome.done)
        return parts.networks.value(params, after, critic_input(config, outcome), never)[1]

    advantage, target = rollout_advantage(
        reward, extras.value, last_value, outcome, value_of_outcome, state.norm, config.ppo
    )
    advantage = jnp.broadcast_to(advantage, transitions.action.shape)
    greedy = mark_greedy(config)
    advantage = normalize_and_blame(
        advantage, timestep.action_mask, outcome.reward, greedy, normalize
    )
    steps = SequenceBatch(
        memory=extras.memory,
        first=transitions.first,
        obs=timestep.obs,
        state=critic_input(config, timestep),
        action_mask=timestep.action_mask,
        action=transitions.action,
        log_prob=extras.log_prob,
        value=extras.value,
        advantage=advantage,
        target=target,
    )
    return sequences(steps, config.ppo.sequence_length)


def mappo_loss(
    parts: Parts,
    params: dict,
    norm: ValueNorm,
    batch: SequenceBatch,
    entropy_coef: float | Float[Array, ""] | None = None,
) -> tuple[Float[Array, ""], Metrics]:
    """Return the clipped policy loss minus the entropy, plus the clipped value loss.

    Policy loss and entropy are means over the agents that have a choice, the value loss over all.
    On-policy uses two losses and two optimizers, here they are one. The steps are the same, since
    nothing is shared and each network is clipped by its own norm. `entropy_coef` overrides that of
    the configuration.
    """
    config = parts.config
    if entropy_coef is None:
        entropy_coef = config.entropy_coef
    return sequence_loss(params, parts.networks, norm, batch, config.ppo, entropy_coef)


def train_iteration(parts: Parts, state: MAPPOState) -> tuple[MAPPOState, Metrics]:
    """Do one rollout and all learning from it."""
    key, key_rollout, key_epochs = jax.random.split(state.key, 3)
    ppo = parts.config.ppo
    env, memory, transitions = rollouts.unroll(
        parts.env, act_and_evaluate(parts, state.learner.params),
        state.env, state.memory, key_rollout, ppo.rollout_length,
    )  # fmt: skip
    key_bonus, key_store = jax.random.split(key_beside(key, 0))
    bonus_state, bonus, bonus_metrics = parts.bonus.update(
        state.bonus, transitions.outcome, key_bonus
    )
    reward = (transitions.outcome.reward + bonus)[..., None]
    batch = make_batch(parts, state, transitions, env, memory.critic, reward)
    coef = actions_entropy_coef(parts.bonus, state.bonus, parts.config, parts.config.entropy_coef)
    optimizer = scale_steps(parts.optimizer, step_factor(parts.bonus, state.bonus, parts.config))
    learner, norm, metrics = ppo_epochs(
        optimizer, partial(mappo_loss, parts, entropy_coef=coef), state.learner,
        state.norm, batch, key_epochs, ppo,
    )  # fmt: skip
    successes, store_metrics = parts.imitation.store(state.successes, batch, transitions, key_store)
    learner, imitation_metrics = parts.imitation.train(successes, learner, optimizer)
    explore_metrics = bonus_metrics | store_metrics | imitation_metrics
    metrics |= {f"exploration/{k}": v for k, v in explore_metrics.items()}
    next_state = MAPPOState(
        key=key,
        num_updates=state.num_updates + 1,
        env=env,
        memory=memory,
        learner=learner,
        norm=norm,
        bonus=bonus_state,
        successes=successes,
    )
    return next_state, metrics | rollouts.rollout_metrics(transitions.outcome)
