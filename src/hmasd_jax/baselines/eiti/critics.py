"""Further critics of EDTI: for each agent the value of team reward and of its curiosity bonus.

They learn like the critic of PPO, each from its own reward, and act on nothing. K = 2 N is their
number; those of one agent are side by side.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

from envs_jax import TimeStep
from hmasd_jax.networks.actor_critic import ActorCritic
from hmasd_jax.rl import rollout as rollouts
from hmasd_jax.rl.gae import gae, values_after
from hmasd_jax.rl.ppo import PPOConfig, value_loss
from hmasd_jax.rl.sgd import ppo_epochs
from hmasd_jax.rl.value_norm import ValueNorm, denormalize, normalize
from hmasd_jax.types import EnvCarry, Key, Learner, Metrics, Transition

STREAMS = 2
"""Critics of an agent: of the team reward, and of the curiosity bonus."""


@dataclass(frozen=True)
class CriticParts:
    """Static components of the critics."""

    config: PPOConfig
    one: ActorCritic
    """Networks of a single agent."""
    each: ActorCritic
    """The same with an axis of agents in parameters and inputs."""
    optimizer: optax.GradientTransformation
    """Optimizer of a single critic."""


class Critics(NamedTuple):
    """State of the K critics."""

    learner: Learner
    """All arrays begin with the axis K."""
    norm: ValueNorm
    """(K,)."""
    memory: Float[Array, "E K hidden"]


class Evaluated(NamedTuple):
    """Values of the steps of a rollout."""

    memory: Float[Array, "T E K hidden"]
    """Memory before each step."""
    last_memory: Float[Array, "E K hidden"]
    """Memory after the rollout."""
    value: Float[Array, "T E K"]
    """Values of the critics, in normalized units."""
    after: Float[Array, "T E K"]
    """Values of what each step led to, in reward units; 0 where the episode ended."""


class CriticBatch(NamedTuple):
    """Sequences of L steps for each critic."""

    memory: Float[Array, "K S hidden"]
    """Memory before the first step."""
    first: Bool[Array, "K S L"]
    obs: Float[Array, "K S L obs"]
    value: Float[Array, "K S L"]
    """Values of the critics, in normalized units."""
    target: Float[Array, "K S L"]
    """Returns in reward units."""


def init(parts: CriticParts, env: EnvCarry, key: Key) -> Critics:
    """Initialize the critics."""
    obs = _inputs(env.timestep)
    memory = jnp.zeros((*obs.shape[:-1], parts.config.hidden_size))
    first = jnp.ones((1, *obs.shape[:-1]), bool)
    params = {"critic": parts.each.critic.init(key, memory, obs[None], first, None)}
    zeros = jnp.zeros(obs.shape[-2])
    return Critics(
        learner=Learner(params, jax.vmap(parts.optimizer.init)(params)),
        norm=ValueNorm(zeros, zeros, zeros),
        memory=memory,
    )


def _inputs(timestep: TimeStep) -> Float[Array, "*batch K obs"]:
    """Return the input of each critic: its agent's observation."""
    return jnp.repeat(timestep.obs, STREAMS, axis=-2)


def evaluate(
    parts: CriticParts, critics: Critics, transitions: Transition, env: EnvCarry
) -> Evaluated:
    """Compute the values of the steps of a rollout. `env` are the copies after the last one."""
    value_of = partial(parts.each.value, critics.learner.params)
    outcome = transitions.outcome

    def step(memory, seen):
        next_memory, value = value_of(memory, *seen)
        return next_memory, (memory, value)

    seen = (_inputs(transitions.timestep), transitions.first)
    last_memory, (memory, value) = jax.lax.scan(step, critics.memory, seen)
    _, last_value = value_of(last_memory, _inputs(env.timestep), env.first)

    def value_of_outcome():
        next_memory = rollouts.following(memory, last_memory)
        return value_of(next_memory, _inputs(outcome), jnp.zeros_like(outcome.done))[1]

    after, terminated = values_after(value, last_value, outcome, value_of_outcome, parts.config)
    after = jnp.where(terminated, 0.0, denormalize(critics.norm, after))
    return Evaluated(memory=memory, last_memory=last_memory, value=value, after=after)


def train(
    parts: CriticParts,
    critics: Critics,
    evaluated: Evaluated,
    transitions: Transition,
    reward: Float[Array, "T E K"],
    key: Key,
) -> tuple[Critics, Metrics]:
    """Learn the values of `reward`."""
    config, done = parts.config, transitions.outcome.done[..., None]
    _, target = gae(
        reward, denormalize(critics.norm, evaluated.value), evaluated.after,
        jnp.zeros_like(done), done, config.discount, config.gae_lambda,
    )  # fmt: skip
    by_step = {
        "first": jnp.broadcast_to(transitions.first[..., None], target.shape),
        "obs": _inputs(transitions.timestep),
        "value": evaluated.value,
        "target": target,
    }
    length = config.sequence_length
    memory = rollouts.flatten(evaluated.memory[::length])
    batch = CriticBatch(
        memory=jnp.moveaxis(memory, 1, 0),
        **{name: jnp.moveaxis(x, 2, 0) for name, x in rollouts.cut(by_step, length).items()},
    )
    learn = jax.vmap(partial(_learn, parts), in_axes=(0, 0, 0, None))
    learner, norm, metrics = learn(critics.learner, critics.norm, batch, key)
    critics = Critics(learner=learner, norm=norm, memory=evaluated.last_memory)
    return critics, {f"critics/{name}": x.mean() for name, x in metrics.items()}


def _learn(parts: CriticParts, learner: Learner, norm: ValueNorm, batch: CriticBatch, key: Key):
    """Run the epochs of a single critic."""
    loss = partial(critic_loss, parts)
    return ppo_epochs(parts.optimizer, loss, learner, norm, batch, key, parts.config)


def critic_loss(
    parts: CriticParts, params: dict, norm: ValueNorm, batch: CriticBatch
) -> tuple[Float[Array, ""], Metrics]:
    """Return the clipped value loss of a single critic, whose batch has no axis K."""
    config = parts.config
    obs, first = batch.obs.swapaxes(0, 1), batch.first.swapaxes(0, 1)  # time first
    _, value = parts.one.value(params, batch.memory, obs, first)
    loss = value_loss(
        value.T, batch.value, normalize(norm, batch.target),
        config.clip_epsilon, config.huber_delta,
    )  # fmt: skip
    return config.value_coef * loss, {"value_loss": loss}
