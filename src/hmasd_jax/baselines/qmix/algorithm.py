"""VDN, QMIX and MASER as algorithms: act epsilon-greedily, replay episodes, learn."""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from envs_jax import Environment
from hmasd_jax.baselines.qmix import maser
from hmasd_jax.baselines.qmix import replay as replays
from hmasd_jax.baselines.qmix.config import MASERConfig, QLearningConfig, QMIXConfig, VDNConfig
from hmasd_jax.baselines.qmix.learner import Loss, factorization_loss, make_optimizer
from hmasd_jax.baselines.qmix.networks import (
    AgentMemory,
    AgentNet,
    DistanceNet,
    MASERNetworks,
    Networks,
    QMIXMixer,
    VDNMixer,
)
from hmasd_jax.baselines.qmix.replay import Replay, Seen, Step
from hmasd_jax.rl import rollout as rollouts
from hmasd_jax.rl.categorical import mask_logits
from hmasd_jax.rl.sgd import gradient_step
from hmasd_jax.types import Algorithm, EnvCarry, Key, Learner, Metrics, Policy


class QLearningState(NamedTuple):
    """State of training: everything that the next update depends on."""

    key: Key
    num_updates: Int[Array, ""]
    env: EnvCarry
    memory: AgentMemory
    learner: Learner
    target_params: dict
    replay: Replay


@dataclass(frozen=True)
class Parts:
    """Static components that the pure functions take."""

    env: Environment
    config: QLearningConfig
    networks: Networks
    loss: Loss
    optimizer: optax.GradientTransformation


def make_vdn(env: Environment, config: VDNConfig) -> Algorithm:
    """Build VDN for `env`."""
    networks = Networks(_agent(env, config.q_learning), VDNMixer())
    loss = partial(factorization_loss, networks, config.q_learning.discount)
    return make_algorithm(env, config.q_learning, networks, loss)


def make_qmix(env: Environment, config: QMIXConfig) -> Algorithm:
    """Build QMIX for `env`."""
    networks = Networks(_agent(env, config.q_learning), QMIXMixer(config.mixing_size))
    loss = partial(factorization_loss, networks, config.q_learning.discount)
    return make_algorithm(env, config.q_learning, networks, loss)


def make_maser(env: Environment, config: MASERConfig) -> Algorithm:
    """Build MASER for `env`."""
    mixer, distance = QMIXMixer(config.mixing_size), DistanceNet(env.num_actions)
    networks = MASERNetworks(_agent(env, config.q_learning), mixer, distance)
    loss = partial(maser.LOSSES[config.variant], networks, config)
    return make_algorithm(env, config.q_learning, networks, loss)


def _agent(env: Environment, config: QLearningConfig) -> AgentNet:
    return AgentNet(env.num_actions, config.hidden_size)


def make_algorithm(
    env: Environment, config: QLearningConfig, networks: Networks, loss: Loss
) -> Algorithm:
    """Build an algorithm from networks and a loss."""
    parts = Parts(env, config, networks, loss, make_optimizer(config))
    return Algorithm(
        partial(init_state, parts), partial(train_iteration, parts), partial(make_policy, parts)
    )


def init_state(parts: Parts, key: Key) -> QLearningState:
    """Initialize the networks, an empty replay, and E copies at the start of an episode."""
    key, key_env, key_networks = jax.random.split(key, 3)
    config, env = parts.config, rollouts.reset(parts.env, key_env, parts.config.num_envs)
    timestep = env.timestep
    params = parts.networks.init(key_networks, timestep)
    memory = parts.networks.init_memory(timestep.obs.shape[:-1])
    step = Step(
        seen=Seen(timestep.obs, timestep.state, timestep.action_mask),
        action=memory.last_action,
        reward=timestep.reward,
        terminated=timestep.terminated,
    )
    return QLearningState(
        key=key,
        num_updates=jnp.int32(0),
        env=env,
        memory=memory,
        learner=Learner(params, parts.optimizer.init(params)),
        target_params=params,
        replay=replays.init(step, config.buffer_size, parts.env.max_steps, config.rollout_length),
    )


def epsilon(config: QLearningConfig, num_updates: Int[Array, ""]) -> Float[Array, ""]:
    """Return the probability of a random action, which falls linearly with environment steps."""
    env_steps = num_updates * float(config.num_envs * config.rollout_length)
    done = jnp.minimum(env_steps / max(config.epsilon_steps, 1), 1.0)
    return config.epsilon_start + done * (config.epsilon_end - config.epsilon_start)


def epsilon_greedy(
    values: Float[Array, "*batch actions"],
    action_mask: Bool[Array, "*batch actions"],
    epsilon: Float[Array, ""],
    key: Key,
) -> Int[Array, "*batch"]:
    """Take the best legal action, or any legal action with probability `epsilon`."""
    key_whether, key_which = jax.random.split(key)
    best = mask_logits(values, action_mask).argmax(-1)
    anything = jax.random.categorical(key_which, mask_logits(jnp.zeros_like(values), action_mask))
    return jnp.where(jax.random.uniform(key_whether, best.shape) < epsilon, anything, best)


def make_policy(parts: Parts, state: QLearningState, greedy: bool = True) -> Policy:
    """Build the policy for execution: greedy, or epsilon-greedy as in the next rollout."""
    chance = jnp.float32(0) if greedy else epsilon(parts.config, state.num_updates)

    def init(batch_shape: tuple[int, ...] = ()) -> AgentMemory:
        return parts.networks.init_memory((*batch_shape, parts.env.num_agents))

    def step(memory, timestep, first, key):
        hidden, values = parts.networks.act(state.learner.params, memory, timestep, first)
        action = epsilon_greedy(values, timestep.action_mask, chance, key)
        return AgentMemory(hidden, action), action, ()

    return Policy(init, step)


def learn(
    parts: Parts, state: QLearningState, replay: Replay, key: Key
) -> tuple[Learner, dict, Metrics]:
    """Take the gradient steps of one update, each on newly drawn episodes.

    Nothing is learned while fewer episodes have ended than a batch holds. Metrics are then 0.

    Returns:
        The learner, the target networks, and the metrics averaged over the steps.
    """
    config = parts.config

    def step(learner: Learner, target_params: dict, key: Key) -> tuple[Learner, Metrics]:
        episodes = replays.sample(replay, key, config.batch_size, parts.env.max_steps)
        return gradient_step(learner, parts.optimizer, parts.loss, target_params, episodes)

    def skip(learner: Learner, target_params: dict, key: Key) -> tuple[Learner, Metrics]:
        shapes = jax.eval_shape(step, learner, target_params, key)[1]
        return learner, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def step_and_copy(carry, inputs):
        learner, target_params = carry
        number, key = inputs
        ready = replay.ended >= config.batch_size
        learner, metrics = jax.lax.cond(ready, step, skip, learner, target_params, key)
        copies = number % config.target_interval == 0
        target_params = jax.tree.map(partial(jnp.where, copies), learner.params, target_params)
        return (learner, target_params), metrics

    # The number of each gradient step of the run, from 1.
    numbers = state.num_updates * config.gradient_steps + 1 + jnp.arange(config.gradient_steps)
    keys = jax.random.split(key, config.gradient_steps)
    (learner, target_params), metrics = jax.lax.scan(
        step_and_copy, (state.learner, state.target_params), (numbers, keys)
    )
    return learner, target_params, jax.tree.map(jnp.mean, metrics)


def train_iteration(parts: Parts, state: QLearningState) -> tuple[QLearningState, Metrics]:
    """Do one rollout, add it to the replay, and learn from replayed episodes."""
    key, key_rollout, key_learn = jax.random.split(state.key, 3)
    config = parts.config
    policy = make_policy(parts, state, greedy=False)
    env, memory, transitions = rollouts.unroll(
        parts.env, policy.step, state.env, state.memory, key_rollout, config.rollout_length
    )
    replay = replays.add(state.replay, transitions, config.bootstrap_truncation)
    learner, target_params, metrics = learn(parts, state, replay, key_learn)
    metrics |= {"epsilon": epsilon(config, state.num_updates)}
    next_state = QLearningState(
        key=key,
        num_updates=state.num_updates + 1,
        env=env,
        memory=memory,
        learner=learner,
        target_params=target_params,
        replay=replay,
    )
    return next_state, metrics | rollouts.rollout_metrics(transitions.outcome)
