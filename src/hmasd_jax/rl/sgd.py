"""Gradient steps, and epochs of shuffled minibatches."""

from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from hmasd_jax.rl import value_norm
from hmasd_jax.rl.averaging import track_average
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.rl.value_norm import ValueNorm
from hmasd_jax.types import Key, Learner, Metrics

Carry = TypeVar("Carry")
Batch = TypeVar("Batch")
LossFn = Callable[..., tuple[Float[Array, ""], Metrics]]


def make_optimizer(
    config: PPOConfig, networks: Sequence[str], steps_per_update: int | None = None
) -> optax.GradientTransformationExtraArgs:
    """Build Adam that clips each network's gradient by its own norm first.

    Args:
        config: learning rate, Adam's epsilon, the norm to clip at, and what is averaged.
        networks: top-level names in the parameters. Each is clipped separately.
        steps_per_update: gradient steps per rollout, for the schedule. The default is that of PPO.
    """
    per_update = steps_per_update or config.steps_per_update
    step_size: optax.ScalarOrSchedule = config.learning_rate
    if config.decay_updates:
        step_size = optax.linear_schedule(
            config.learning_rate, 0.0, config.decay_updates * per_update
        )
    adam = take_step_factor(optax.adam(step_size, eps=config.adam_epsilon))
    steps = [clip_by_norm(config.max_grad_norm), adam]
    if config.average_updates:
        steps.append(track_average(1.0 - 1.0 / (config.average_updates * per_update)))
    # One vector per network: XLA compiles and launches a quarter fewer kernels.
    each = optax.flatten(optax.chain(*steps))
    transforms: dict[Hashable, optax.GradientTransformation] = dict.fromkeys(networks, each)
    return optax.partition(transforms, {name: name for name in networks})


def take_step_factor(
    optimizer: optax.GradientTransformation,
) -> optax.GradientTransformationExtraArgs:
    """Let the optimizer's `update` take `step_factor`, which multiplies its steps."""

    def update(updates, state, params=None, *, step_factor=1.0, **_):
        steps, state = optimizer.update(updates, state, params)
        return optax.tree.scale(step_factor, steps), state

    return optax.GradientTransformationExtraArgs(optimizer.init, update)


def scale_steps(
    optimizer: optax.GradientTransformationExtraArgs, factor: float | Float[Array, ""]
) -> optax.GradientTransformation:
    """Multiply the steps of an optimizer of `make_optimizer` by a factor that training may change.

    The average of the parameters follows the shorter steps. The moments of Adam do not change.
    """
    return optax.GradientTransformation(
        optimizer.init, partial(optimizer.update, step_factor=factor)
    )


def clip_by_norm(max_norm: float) -> optax.GradientTransformation:
    """Clip a vector like optax's `clip_by_global_norm`, with the norm computed as a product.

    XLA splits a sum into several kernels on a CPU, which take longer to compile.
    """

    def clip(gradient, _params):
        norm = vector_norm(gradient)
        return jnp.where(norm < max_norm, gradient, gradient / norm * max_norm)

    return optax.stateless(clip)


def vector_norm(x: Float[Array, " size"]) -> Float[Array, ""]:
    """Return the Euclidean norm."""
    return jnp.sqrt(jnp.vdot(x, x, precision="highest"))


def gradient_step(
    learner: Learner, optimizer: optax.GradientTransformation, loss_fn: LossFn, *args: Any
) -> tuple[Learner, Metrics]:
    """Take one step down the gradient of `loss_fn(params, *args) -> (loss, metrics)`."""
    grads, metrics = jax.grad(loss_fn, has_aux=True)(learner.params, *args)
    updates, opt_state = optimizer.update(grads, learner.opt_state, learner.params)
    norms = [vector_norm(ravel_pytree(grad)[0]) for grad in grads.values()]
    metrics = metrics | {"grad_norm": vector_norm(jnp.stack(norms))}
    return Learner(optax.apply_updates(learner.params, updates), opt_state), metrics


def sgd_epochs(
    step: Callable[[Carry, Batch], tuple[Carry, Metrics]],
    carry: Carry,
    batch: Batch,
    key: Key,
    num_epochs: int,
    num_minibatches: int,
) -> tuple[Carry, Metrics]:
    """Run `step` on every minibatch, `num_epochs` times over.

    Args:
        step: `(carry, minibatch) -> (carry, metrics)`.
        carry: state that learns, e.g. a `Learner`.
        batch: arrays with samples on their first axis, a multiple of `num_minibatches`.
        key: PRNG key that shuffles the samples in each epoch. One minibatch is not shuffled, since
            order has no effect on a mean.
        num_epochs: passes over the batch.
        num_minibatches: steps per pass.

    Returns:
        The final carry, and the metrics averaged over all steps.
    """
    size = jax.tree.leaves(batch)[0].shape[0]

    def shuffle(key: Key) -> Batch:
        order = jax.random.permutation(key, size).reshape(num_minibatches, -1)
        return jax.tree.map(lambda x: x[order], batch)

    def epoch(carry: Carry, key: Key) -> tuple[Carry, Metrics]:
        if num_minibatches == 1:
            return step(carry, batch)
        carry, metrics = jax.lax.scan(step, carry, shuffle(key))
        return carry, jax.tree.map(jnp.mean, metrics)

    carry, metrics = jax.lax.scan(epoch, carry, jax.random.split(key, num_epochs))
    return carry, jax.tree.map(jnp.mean, metrics)


def ppo_step(
    optimizer: optax.GradientTransformation,
    loss_fn: LossFn,
    carry: tuple[Learner, ValueNorm],
    minibatch: Any,
) -> tuple[tuple[Learner, ValueNorm], Metrics]:
    """Update the value normalizer with the targets of a minibatch, then take a gradient step."""
    learner, norm = carry
    norm = value_norm.update(norm, minibatch.target)
    learner, metrics = gradient_step(learner, optimizer, loss_fn, norm, minibatch)
    return (learner, norm), metrics


def ppo_epochs(
    optimizer: optax.GradientTransformation,
    loss_fn: LossFn,
    learner: Learner,
    norm: ValueNorm,
    batch: Any,
    key: Key,
    config: PPOConfig,
) -> tuple[Learner, ValueNorm, Metrics]:
    """Run the epochs of PPO, with a `ppo_step` for each minibatch.

    Args:
        optimizer: optimizer of the learner.
        loss_fn: `(params, norm, minibatch) -> (loss, metrics)`.
        learner: actor and critic.
        norm: normalizer of the critic's targets.
        batch: arrays with samples on their first axis. `target` holds returns in reward units.
        key: PRNG key that shuffles the samples.
        config: number of epochs and of minibatches.
    """
    step = partial(ppo_step, optimizer, loss_fn)
    (learner, norm), metrics = sgd_epochs(
        step, (learner, norm), batch, key, config.num_epochs, config.num_minibatches
    )
    return learner, norm, metrics
