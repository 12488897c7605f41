"""Targets, loss and optimizer of value factorization (PyMARL `q_learner.py`).

Axes: T steps, or T + 1 with the one after the last, B episodes, N agents.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

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
