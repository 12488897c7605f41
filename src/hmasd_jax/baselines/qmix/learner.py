"""Targets, loss and optimizer of value factorization (PyMARL `q_learner.py`).

Axes: T steps, or T + 1 with the one after the last, B episodes, N agents.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PyTree

from hmasd_jax.baselines.qmix.chunks import over_chunks
from hmasd_jax.baselines.qmix.config import QLearningConfig
from hmasd_jax.baselines.qmix.networks import Networks
from hmasd_jax.baselines.qmix.replay import Episodes
from hmasd_jax.rl.categorical import mask_logits
from hmasd_jax.rl.ppo import masked_mean
from hmasd_jax.types import Metrics

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


def evaluate_episodes(
    networks: Networks, params: dict, target_params: dict, episodes: Episodes
) -> Values:
    """Evaluate both sets of networks over whole episodes. Values of late padding are 0."""
    seen, action = episodes.seen, episodes.action
    memory = networks.init_memory(seen.obs.shape[1:-1])
    last_action = jnp.concatenate([memory.last_action[None], action])
    none = jnp.zeros_like(action[:1])  # after the last step
    values = over_chunks(
        partial(evaluate_steps, networks),
        params,
        target_params,
        (memory.hidden, memory.hidden),
        (seen, last_action, jnp.concatenate([action, none])),
        episodes.longest,
    )
    return values._replace(taken=values.taken[:-1], total=values.total[:-1])


def evaluate_steps(
    networks: Networks, params: dict, target_params: dict, hidden: PyTree, steps: PyTree
) -> tuple[PyTree, Values]:
    """Evaluate both sets of networks over consecutive steps.

    Args:
        networks: Networks of the algorithm.
        params: Their parameters.
        target_params: Parameters of the target networks.
        hidden: Hidden memories of both before the first step.
        steps: What is seen, the last action and the action of each step.

    Returns:
        The next hidden memories, and values of as many steps in every field.
    """
    seen, last_action, action = steps
    memory, target_memory = hidden
    memory, online = networks.values(params, memory, seen.obs, last_action)
    target_memory, target = networks.values(target_params, target_memory, seen.obs, last_action)
    taken = choose(online, action)
    greedy = choose(target, mask_logits(online, seen.action_mask).argmax(-1))
    values = Values(
        online=online,
        taken=taken,
        total=networks.mix(params, taken, seen.state),
        target=target,
        greedy=greedy,
        greedy_total=networks.mix(target_params, greedy, seen.state),
    )
    return (memory, target_memory), values


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
    values = evaluate_episodes(networks, params, target_params, episodes)
    return td_loss(values, episodes.reward, episodes, discount)


def make_optimizer(config: QLearningConfig) -> optax.GradientTransformation:
    """Build PyTorch's RMSprop behind a clip of the whole gradient."""
    return optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm),
        optax.rmsprop(
            config.learning_rate, config.rms_decay, config.rms_epsilon, eps_in_sqrt=False
        ),
    )
