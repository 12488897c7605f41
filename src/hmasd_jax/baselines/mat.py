"""MAT, the Multi-Agent Transformer (Wen et al., NeurIPS 2022): agents act one after the other.

An encoder reads the observations of all agents and gives each a value; a decoder gives each agent
its action, given the encoding and the actions of the agents before it. As in the authors' code
neither sees the global state, and a token carries nothing that says whose it is.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int

from envs_jax import Environment, TimeStep
from hmasd_jax.networks.actor_critic import agents_loss
from hmasd_jax.networks.layer_norm import LayerNorm
from hmasd_jax.networks.recurrent import RELU_GAIN, apply, dense
from hmasd_jax.networks.transformer import (
    DecoderBlock,
    EncoderBlock,
    Head,
    decoder_inputs,
    draw_in_turn,
    gelu,
)
from hmasd_jax.rl import rollout as rollouts
from hmasd_jax.rl.categorical import categorical, mask_logits
from hmasd_jax.rl.gae import normalize_advantage, rollout_advantage
from hmasd_jax.rl.ppo import PPOConfig, has_choice
from hmasd_jax.rl.sgd import make_optimizer, ppo_epochs
from hmasd_jax.rl.value_norm import ValueNorm
from hmasd_jax.types import Algorithm, EnvCarry, Key, Learner, Metrics, Policy, Transition
from hmasd_jax.validation import check_divides, check_range


@dataclass(frozen=True)
class MATConfig:
    """MAT on one task; the defaults are the paper's."""

    entropy_coef: float = 0.01
    """Weight of the policy's entropy."""
    num_blocks: int = 1
    """Encoder blocks and decoder blocks."""
    num_heads: int = 1
    """Attention heads."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Optimization settings. MAT has no memory: `sequence_length` means nothing to it."""

    def __post_init__(self) -> None:
        check_range(self, "entropy_coef", low=0)
        check_range(self, "num_blocks", "num_heads", low=1)
        check_divides("num_heads", self.num_heads, "ppo.hidden_size", self.ppo.hidden_size)


class MATState(NamedTuple):
    """Everything that training goes on from."""

    key: Key
    num_updates: Int[Array, ""]
    env: EnvCarry
    learner: Learner
    norm: ValueNorm


class Extras(NamedTuple):
    """What the update needs to know about a step."""

    log_prob: Float[Array, "*T E N"]
    value: Float[Array, "*T E N"]
    """In normalized units."""


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


class MultiAgentTransformer(nn.Module):
    """Encoder with a value head, and autoregressive decoder with an action head."""

    num_actions: int
    size: int
    num_blocks: int
    num_heads: int

    def setup(self) -> None:
        """Create the parts."""
        self.embed_obs = nn.Sequential([LayerNorm(), dense(self.size, RELU_GAIN), gelu])
        self.encoder_norm = LayerNorm()
        blocks = range(self.num_blocks)
        self.encoder_blocks = [EncoderBlock(self.size, self.num_heads) for _ in blocks]
        self.value_head = Head(1, self.size)
        self.embed_action = dense(self.size, RELU_GAIN, use_bias=False)
        self.decoder_norm = LayerNorm()
        self.decoder_blocks = [DecoderBlock(self.size, self.num_heads) for _ in blocks]
        self.action_head = Head(self.num_actions, self.size)

    def __call__(
        self,
        obs: Float[Array, "*batch N obs"],
        action_mask: Bool[Array, "*batch N actions"],
        action: Int[Array, "*batch N"],
    ) -> tuple[Float[Array, "*batch N actions"], Float[Array, "*batch N"]]:
        """Teacher-forced: logits of every agent given the actions before it, and all values."""
        encoded, value = self.encode(obs)
        return self.decode(encoded, action_mask, action), value

    def encode(
        self, obs: Float[Array, "*batch N obs"]
    ) -> tuple[Float[Array, "*batch N size"], Float[Array, "*batch N"]]:
        """Encode o^1..o^N into tokens, and a value of each in normalized units."""
        x = self.encoder_norm(self.embed_obs(obs))
        for block in self.encoder_blocks:
            x = block(x)
        return x, self.value_head(x)[..., 0]

    def decode(
        self,
        encoded: Float[Array, "*batch N size"],
        action_mask: Bool[Array, "*batch N actions"],
        action: Int[Array, "*batch N"],
    ) -> Float[Array, "*batch N actions"]:
        """Logits of agent i given actions of agents before it; the others' have no effect."""
        x = gelu(self.embed_action(decoder_inputs(action, self.num_actions)))
        x = self.decoder_norm(x)
        for block in self.decoder_blocks:
            x = block(x, encoded)
        return mask_logits(self.action_head(x), action_mask)


@dataclass(frozen=True)
class Parts:
    """What the pure functions of MAT close over."""

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
    """Network and optimizer; encoder and decoder are clipped by their common norm."""
    network = MultiAgentTransformer(
        env.num_actions, config.ppo.hidden_size, config.num_blocks, config.num_heads
    )
    return Parts(env, config, network, make_optimizer(config.ppo, ["params"]))


def init_state(parts: Parts, key: Key) -> MATState:
    """A fresh network, and E copies at the start of an episode."""
    key, key_env, key_network = jax.random.split(key, 3)
    env = rollouts.reset(parts.env, key_env, parts.config.ppo.num_envs)
    obs, mask = env.timestep.obs, env.timestep.action_mask
    params = parts.network.init(key_network, obs, mask, jnp.zeros(obs.shape[:-1], int))
    learner = Learner(params, parts.optimizer.init(params))
    return MATState(key, jnp.int32(0), env, learner, ValueNorm.create())


def act(
    parts: Parts, params: dict, timestep: TimeStep, key: Key, greedy: bool
) -> tuple[Int[Array, "*batch N"], Extras]:
    """Actions, each given those of the agents before it."""
    encoded, value = apply(parts.network, params, timestep.obs, method="encode")

    def decode(action):
        return apply(parts.network, params, encoded, timestep.action_mask, action, method="decode")

    action, log_prob = draw_in_turn(decode, value.shape, key, greedy)
    return action, Extras(log_prob, value)


def make_policy(parts: Parts, state: MATState, greedy: bool = True) -> Policy:
    """Execution, which is as centralized as training; nothing is remembered."""

    def step(memory, timestep, first, key):
        del first
        action, _ = act(parts, state.learner.params, timestep, key, greedy)
        return memory, action, ()

    return Policy(lambda batch_shape=(): (), step)


def make_batch(parts: Parts, state: MATState, transitions: Transition, env: EnvCarry) -> Batch:
    """Advantages and targets of every agent over a rollout, then one sample per step.

    Args:
        parts: network and settings.
        state: parameters and value normalizer during the rollout.
        transitions: (T, E, ...), with `Extras`.
        env: where the copies stand after the last step.
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
        timestep.obs, timestep.action_mask, transitions.action, extras.log_prob, extras.value,
        advantage, target,
    )  # fmt: skip
    return rollouts.flatten(steps)


def mat_loss(
    params: dict, parts: Parts, norm: ValueNorm, batch: Batch
) -> tuple[Float[Array, ""], Metrics]:
    """Clipped policy loss and entropy of the agents that have a choice, clipped value loss of all.

    All are means over samples and agents. The Huber loss is the correct one: where the authors'
    forgets large errors of one sign, so that they are never learned from, ours does not.
    """
    logits, value = apply(parts.network, params, batch.obs, batch.action_mask, batch.action)
    distribution = categorical(logits)
    config = parts.config
    return agents_loss(distribution, value, batch, norm, config.ppo, config.entropy_coef)


def train_iteration(parts: Parts, state: MATState) -> tuple[MATState, Metrics]:
    """One rollout and all learning from it."""
    key, key_rollout, key_epochs = jax.random.split(state.key, 3)
    ppo = parts.config.ppo

    def step_fn(memory, timestep, first, key):
        del first
        return memory, *act(parts, state.learner.params, timestep, key, greedy=False)

    env, _, transitions = rollouts.unroll(
        parts.env, step_fn, state.env, (), key_rollout, ppo.rollout_length
    )
    batch = make_batch(parts, state, transitions, env)

    def loss_fn(params, norm, batch):
        return mat_loss(params, parts, norm, batch)

    learner, norm, metrics = ppo_epochs(
        parts.optimizer, loss_fn, state.learner, state.norm, batch, key_epochs, ppo
    )
    metrics |= rollouts.episode_metrics(transitions.outcome)
    metrics |= {"team_reward": transitions.outcome.reward.mean()}
    return MATState(key, state.num_updates + 1, env, learner, norm), metrics
