"""Targets, loss and gradient steps of value factorization (PyMARL `q_learner.py`).

Axes: T steps, or T + 1 with the one after the last, B episodes, N agents.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from hmasd_jax.baselines.qmix import replay as replays
from hmasd_jax.baselines.qmix.config import QLearningConfig
from hmasd_jax.baselines.qmix.networks import Networks
from hmasd_jax.baselines.qmix.replay import Episodes, Replay
from hmasd_jax.rl.categorical import mask_logits
from hmasd_jax.rl.ppo import masked_mean
from hmasd_jax.rl.sgd import gradient_step
from hmasd_jax.types import Key, Learner, Metrics

Loss = Callable[[dict, dict, Episodes], tuple[Float[Array, ""], Metrics]]
"""`loss(params, target_params, episodes)`."""


class Values(NamedTuple):
    """Values of a batch of episodes. Only `online`, `taken` and `total` have gradients."""

    online: Float[Array, "time B N actions"]
    """Values of all actions, T + 1 steps."""
    taken: Float[Array, "T B N"]
    """Values of the actions that were taken."""
    total: Float[Array, "T B"]
    """`taken`, mixed."""
    target: Float[Array, "time B N actions"]
    """Values of all actions by the target networks, T + 1 steps."""
    greedy: Float[Array, "time B N"]
    """`target` of the legal action that `online` prefers (double Q-learning), T + 1 steps."""
    greedy_total: Float[Array, "time B"]
    """`greedy`, mixed by the target networks."""


def evaluate(networks: Networks, params: dict, target_params: dict, episodes: Episodes) -> Values:
    """Evaluate both sets of networks over whole episodes."""
    seen, action = episodes.seen, episodes.action
    online = networks.values(params, seen.obs, action)
    target = jax.lax.stop_gradient(networks.values(target_params, seen.obs, action))
    taken = choose(online[:-1], action)
    greedy = choose(target, mask_logits(online, seen.action_mask).argmax(-1))
    return Values(
        online=online,
        taken=taken,
        total=networks.mix(params, taken, seen.state[:-1]),
        target=target,
        greedy=greedy,
        greedy_total=jax.lax.stop_gradient(networks.mix(target_params, greedy, seen.state)),
    )


def choose(
    values: Float[Array, "*batch actions"], action: Int[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Return the value of one action each."""
    return jnp.take_along_axis(values, action[..., None], axis=-1)[..., 0]


def td_loss(
    values: Values, reward: Float[Array, "T B"], episodes: Episodes, discount: float
) -> tuple[Float[Array, ""], Metrics]:
    """Return the mean of (Q_tot - y)^2 over all steps, y = r + gamma (1 - terminated) Q'_tot(t+1).

    Q'_tot are the target networks' values of greedy actions.
    """
    target = reward + discount * (1.0 - episodes.terminated) * values.greedy_total[1:]
    error = values.total - jax.lax.stop_gradient(target)
    loss = masked_mean(error**2, episodes.valid)
    metrics = {
        "td_loss": loss,
        "td_error_abs": masked_mean(abs(error), episodes.valid),
        "q_total": masked_mean(values.total, episodes.valid),
        "target": masked_mean(target, episodes.valid),
    }
    return loss, metrics


def factorization_loss(
    networks: Networks, discount: float, params: dict, target_params: dict, episodes: Episodes
) -> tuple[Float[Array, ""], Metrics]:
    """Return the loss of VDN and QMIX, which differ in their mixer alone."""
    values = evaluate(networks, params, target_params, episodes)
    return td_loss(values, episodes.reward, episodes, discount)


def make_optimizer(config: QLearningConfig) -> optax.GradientTransformation:
    """Build PyTorch's RMSprop behind a clip of the whole gradient."""
    return optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm),
        optax.rmsprop(
            config.learning_rate, config.rms_decay, config.rms_epsilon, eps_in_sqrt=False
        ),
    )


def learn(
    loss: Loss,
    optimizer: optax.GradientTransformation,
    learner: Learner,
    target_params: dict,
    replay: Replay,
    steps_done: Int[Array, ""],
    key: Key,
    config: QLearningConfig,
    max_steps: int,
) -> tuple[Learner, dict, Metrics]:
    """Take the gradient steps of one update, each on a newly drawn batch.

    Nothing is learned while fewer episodes have ended than a batch holds. Metrics are then 0.

    Args:
        loss: Loss of the algorithm.
        optimizer: Optimizer of the learner.
        learner: Networks that learn.
        target_params: Networks that the targets are computed with.
        replay: Episodes.
        steps_done: Gradient steps of earlier updates, which decide when to copy the networks.
        key: PRNG key that draws the batches.
        config: Sizes and intervals.
        max_steps: T, the longest episode.

    Returns:
        The learner, the target networks, and the metrics averaged over the steps.
    """

    def step(learner: Learner, target_params: dict, key: Key) -> tuple[Learner, Metrics]:
        episodes = replays.sample(replay, key, config.batch_size, max_steps)
        return gradient_step(learner, optimizer, loss, target_params, episodes)

    def skip(learner: Learner, target_params: dict, key: Key) -> tuple[Learner, Metrics]:
        shapes = jax.eval_shape(step, learner, target_params, key)[1]
        return learner, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def step_and_copy(carry, inputs):
        learner, target_params = carry
        number, key = inputs
        ready = replay.ended >= config.batch_size
        learner, metrics = jax.lax.cond(ready, step, skip, learner, target_params, key)
        copies = (steps_done + number) % config.target_interval == 0
        target_params = jax.tree.map(partial(jnp.where, copies), learner.params, target_params)
        return (learner, target_params), metrics

    numbers = 1 + jnp.arange(config.gradient_steps)
    keys = jax.random.split(key, config.gradient_steps)
    (learner, target_params), metrics = jax.lax.scan(
        step_and_copy, (learner, target_params), (numbers, keys)
    )
    return learner, target_params, jax.tree.map(jnp.mean, metrics)
