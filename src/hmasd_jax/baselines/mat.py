"""MAT, the Multi-Agent Transformer (Wen et al., NeurIPS 2022): agents act one after another.

An encoder reads the observations of all agents and gives each a value. A decoder gives each agent
its action, given the encoding and the actions of the agents before it. Like in the authors' code,
neither sees the global state, and no token identifies its agent.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from envs_jax import Environment, TimeStep
from hmasd_jax.networks.actor_critic import agents_loss
from hmasd_jax.networks.recurrent import RELU_GAIN, apply, dense
from hmasd_jax.networks.transformer import EncoderDecoder, Head, decoder_inputs, draw_in_turn
from hmasd_jax.rl import rollout as rollouts
from hmasd_jax.rl.averaging import averaged_params
from hmasd_jax.rl.categorical import categorical, mask_logits
from hmasd_jax.rl.gae import normalize_advantage, rollout_advantage
from hmasd_jax.rl.ppo import PPOConfig, has_choice
from hmasd_jax.rl.sgd import make_optimizer, ppo_epochs
from hmasd_jax.rl.value_norm import ValueNorm
from hmasd_jax.types import Algorithm, EnvCarry, Key, Learner, Metrics, Policy, Transition
from hmasd_jax.validation import check_divides, check_range, check_types


@dataclass(frozen=True)
class MATConfig:
    """Settings of MAT. The defaults are the paper's."""

    entropy_coef: float = 0.01
    """Weight of the policy's entropy."""
    num_blocks: int = 1
    """Encoder blocks and decoder blocks."""
    num_heads: int = 1
    """Attention heads."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Optimization settings. MAT has no memory and ignores `sequence_length`."""

    def __post_init__(self) -> None:
        check_types(self)
        check_range(self, "entropy_coef", low=0)
        check_range(self, "num_heads", low=1)
        check_range(self, "num_blocks", low=1, high=100)
        check_divides("num_heads", self.num_heads, "ppo.hidden_size", self.ppo.hidden_size)
        steps = self.ppo.num_envs * self.ppo.rollout_length
        check_divides(
            "ppo.num_minibatches", self.ppo.num_minibatches, "num_envs x rollout_length", steps
        )


CHUNK = 400
"""Samples that the network reads at once in training on a CPU, so that arrays fit its cache."""


class MATState(NamedTuple):
    """State of training: everything that the next update depends on."""

    key: Key
    num_updates: Int[Array, ""]
    env: EnvCarry
    learner: Learner
    norm: ValueNorm


class Extras(NamedTuple):
    """Record of a step that the update needs."""

    log_prob: Float[Array, "*T E N"]
    value: Float[Array, "*T E N"]
    """Value of each agent, in normalized units."""


class Batch(NamedTuple):
    """One step of all agents of one environment copy per sample."""

    obs: Float[Array, "S N obs"]
    action_mask: Bool[Array, "S N actions"]
    action: Int[Array, "S N"]
    log_prob: Float[Array, "S N"]
    value: Float[Array, "S N"]
    advantage: Float[Array, "S N"]
    target: Float[Array, "S N"]
    """Returns in reward units."""


class MultiAgentTransformer(EncoderDecoder):
    """Transformer with a value and an action per agent."""

    num_actions: int

    def setup(self) -> None:
        """Create the layers."""
        super().setup()
        self.embed_obs = self.embedding()
        self.embed_action = dense(self.size, RELU_GAIN, use_bias=False)
        self.action_head = Head(self.num_actions, self.size)

    def __call__(
        self,
        obs: Float[Array, "*batch N obs"],
        action_mask: Bool[Array, "*batch N actions"],
        action: Int[Array, "*batch N"],
    ) -> tuple[Float[Array, "*batch N actions"], Float[Array, "*batch N"]]:
        """Return logits of every agent given the actions before it, and a value per agent."""
        encoded, value = self.encode(obs)
        return self.decode(encoded, action_mask, action), value

    def encode(
        self, obs: Float[Array, "*batch N obs"]
    ) -> tuple[Float[Array, "*batch N size"], Float[Array, "*batch N"]]:
        """Encode o^1..o^N into tokens, and a value of each in normalized units."""
        return self.encode_tokens(self.embed_obs(obs))

    def decode(
        self,
        encoded: Float[Array, "*batch N size"],
        action_mask: Bool[Array, "*batch N actions"],
        action: Int[Array, "*batch N"],
    ) -> Float[Array, "*batch N actions"]:
        """Return the logits of agent i given the actions before it. Later ones have no effect."""
        embedded = self.embed_action(decoder_inputs(action, self.num_actions))
        return mask_logits(self.action_head(self.decode_tokens(embedded, encoded)), action_mask)


@dataclass(frozen=True)
class Parts:
    """Static components that the pure functions of MAT take."""

    env: Environment
    config: MATConfig
    network: MultiAgentTransformer
    optimizer: optax.GradientTransformation


def make_mat(env: Environment, config: MATConfig) -> Algorithm:
    """Build MAT for `env`."""
    parts = make_parts(env, config)
    return Algorithm(
        partial(init_state, parts), partial(train_iteration, parts), partial(make_policy, parts)
    )


def make_parts(env: Environment, config: MATConfig) -> Parts:
    """Build network and optimizer. Encoder and decoder are clipped by their common norm."""
    network = MultiAgentTransformer(
        size=config.ppo.hidden_size,
        num_blocks=config.num_blocks,
        num_heads=config.num_heads,
        num_actions=env.num_actions,
    )
    optimizer = make_optimizer(config.ppo, ["params"])
    return Parts(env=env, config=config, network=network, optimizer=optimizer)


def init_state(parts: Parts, key: Key) -> MATState:
    """Initialize the network, and E copies at the start of an episode."""
    key, key_env, key_network = jax.random.split(key, 3)
    env = rollouts.reset(parts.env, key_env, parts.config.ppo.num_envs)
    obs, mask = env.timestep.obs, env.timestep.action_mask
    params = parts.network.init(key_network, obs, mask, jnp.zeros(obs.shape[:-1], int))
    learner = Learner(params, parts.optimizer.init(params))
    return MATState(
        key=key, num_updates=jnp.int32(0), env=env, learner=learner, norm=ValueNorm.create()
    )


def act(
    parts: Parts, params: dict, timestep: TimeStep, key: Key, greedy: bool
) -> tuple[Int[Array, "*batch N"], Extras]:
    """Choose the action of each agent, given those of the agents before it."""
    encoded, value = apply(parts.network, params, timestep.obs, method="encode")

    def decode(action):
        return apply(parts.network, params, encoded, timestep.action_mask, action, method="decode")

    action, log_prob = draw_in_turn(decode, value.shape, key, greedy)
    return action, Extras(log_prob=log_prob, value=value)


def make_policy(parts: Parts, state: MATState, greedy: bool = True) -> Policy:
    """Build the policy for execution, which is as centralized as training. It has no memory."""
    params = averaged_params(state.learner)

    def step(memory, timestep, first, key):
        del first
        action, _ = act(parts, params, timestep, key, greedy)
        return memory, action, ()

    return Policy(lambda batch_shape=(): (), step)


def make_batch(parts: Parts, state: MATState, transitions: Transition, env: EnvCarry) -> Batch:
    """Compute advantages and targets of every agent, and make one sample of each step.

    Args:
        parts: network and settings.
        state: parameters and value normalizer during the rollout.
        transitions: (T, E, ...), with `Extras`.
        env: the copies after the last step.
    """
    timestep, extras, outcome = transitions.timestep, transitions.extras, transitions.outcome

    def value_of(obs):
        return apply(parts.network, state.learner.params, obs, method="encode")[1]

    advantage, target = rollout_advantage(
        outcome.reward[..., None], extras.value, value_of(env.timestep.obs), outcome,
        lambda: value_of(outcome.obs), state.norm, parts.config.ppo,
    )  # fmt: skip
    advantage = normalize_advantage(advantage, has_choice(timestep.action_mask))
    steps = Batch(
        obs=timestep.obs,
        action_mask=timestep.action_mask,
        action=transitions.action,
        log_prob=extras.log_prob,
        value=extras.value,
        advantage=advantage,
        target=target,
    )
    return rollouts.flatten(steps)


def mat_loss(
    parts: Parts, params: dict, norm: ValueNorm, batch: Batch
) -> tuple[Float[Array, ""], Metrics]:
    """Return the clipped policy loss minus the entropy, plus the clipped value loss.

    Policy loss and entropy are means over the agents that have a choice, the value loss over all.
    The Huber loss is the correct one. The authors' drops large errors of one sign and never learns
    from them.
    """
    logits, value = replay(parts, params, batch)
    distribution = categorical(logits)
    config = parts.config
    return agents_loss(distribution, value, batch, norm, config.ppo, config.entropy_coef)


def replay(
    parts: Parts, params: dict, batch: Batch
) -> tuple[Float[Array, "S N actions"], Float[Array, "S N"]]:
    """Return logits and values of all samples.

    A CPU computes them chunk by chunk, and again for the gradient. That takes less time than one
    pass over arrays that do not fit its cache.
    """

    def network(inputs):
        return apply(parts.network, params, *inputs)

    inputs = (batch.obs, batch.action_mask, batch.action)
    if jax.default_backend() != "cpu":
        return network(inputs)
    return jax.lax.map(jax.checkpoint(network), inputs, batch_size=CHUNK)


def train_iteration(parts: Parts, state: MATState) -> tuple[MATState, Metrics]:
    """Do one rollout and all learning from it."""
    key, key_rollout, key_epochs = jax.random.split(state.key, 3)
    ppo = parts.config.ppo

    def step_fn(memory, timestep, first, key):
        del first
        return memory, *act(parts, state.learner.params, timestep, key, greedy=False)

    env, _, transitions = rollouts.unroll(
        parts.env, step_fn, state.env, (), key_rollout, ppo.rollout_length
    )
    batch = make_batch(parts, state, transitions, env)
    learner, norm, metrics = ppo_epochs(
        parts.optimizer, partial(mat_loss, parts), state.learner, state.norm, batch, key_epochs, ppo
    )
    next_state = MATState(
        key=key, num_updates=state.num_updates + 1, env=env, learner=learner, norm=norm
    )
    return next_state, metrics | rollouts.rollout_metrics(transitions.outcome)
