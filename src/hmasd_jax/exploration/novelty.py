"""Exploration bonus for states not seen before: random network distillation (Burda et al., 2019).

A predictor learns the outputs of a fixed random network on the global state. Its error is large
where the state is new. One bonus serves all agents.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jaxtyping import Array, Float

from envs_jax import Environment, TimeStep
from hmasd_jax.exploration.bonus import NO_BONUS, Bonus
from hmasd_jax.networks.recurrent import RELU_GAIN, apply, dense
from hmasd_jax.rl import moments
from hmasd_jax.rl import rollout as rollouts
from hmasd_jax.rl.moments import Moments
from hmasd_jax.rl.sgd import sgd_epochs
from hmasd_jax.types import Key, Learner
from hmasd_jax.validation import check_range, check_types

CLIP = 5.0
"""Largest standardized input, as in the reference."""
FEATURES = 32
HIDDEN = 64


@dataclass(frozen=True)
class NoveltyConfig:
    """Settings of the bonus."""

    coef: float = 0.0
    """Weight of the bonus in the reward, for a bonus in standard deviations of all errors so far,
    which is never below 0. With 0 there is none."""
    epochs: int = 4
    """Gradient steps on the predictor per rollout, each on the whole rollout."""
    learning_rate: float = 1e-4
    """Step size of Adam for the predictor."""

    def __post_init__(self) -> None:
        check_types(self)
        check_range(self, "coef", "learning_rate", low=0)
        check_range(self, "epochs", low=1)


class NoveltyState(NamedTuple):
    """State of the bonus."""

    target: Any
    """Parameters of the fixed network."""
    predictor: Learner
    inputs: Moments
    """Moments of the states seen so far."""
    errors: Moments
    """Moments of the prediction errors so far, which give the bonus its unit."""


class Features(nn.Module):
    """ReLU network on standardized inputs."""

    num_layers: int

    @nn.compact
    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch features"]:
        """Map inputs to features."""
        for _ in range(self.num_layers):
            x = nn.relu(dense(HIDDEN, RELU_GAIN)(x))
        return dense(FEATURES, 1.0)(x)


TARGET, PREDICTOR = Features(num_layers=2), Features(num_layers=3)


def make_novelty(env: Environment, config: NoveltyConfig) -> Bonus:
    """Build the bonus for `env`. It pays nothing if its weight is 0."""
    if config.coef == 0:
        return NO_BONUS
    optimizer = optax.adam(config.learning_rate)

    def init(key: Key) -> NoveltyState:
        key_target, key_predictor = jax.random.split(key)
        state = jnp.zeros((1, env.state_dim))
        params = PREDICTOR.init(key_predictor, state)
        return NoveltyState(
            target=TARGET.init(key_target, state),
            predictor=Learner(params, optimizer.init(params)),
            inputs=Moments.create(env.state_dim),
            errors=Moments.create(),
        )

    def update(novelty: NoveltyState, outcome: TimeStep, key: Key):
        states = rollouts.flatten(outcome.state)
        errors, error_moments = measure(novelty, states)
        reward = config.coef * errors / jnp.sqrt(error_moments.variance + 1e-8)
        seen = novelty._replace(inputs=moments.update(novelty.inputs, states), errors=error_moments)

        def step(learner, states):
            grads = jax.grad(lambda p: prediction_error(seen, p, states).mean())(learner.params)
            updates, opt_state = optimizer.update(grads, learner.opt_state)
            return Learner(optax.apply_updates(learner.params, updates), opt_state), {}

        predictor, _ = sgd_epochs(step, novelty.predictor, states, key, config.epochs, 1)
        metrics = {"novelty_error": errors.mean()}
        return seen._replace(predictor=predictor), reward.reshape(outcome.reward.shape), metrics

    return Bonus(init, update)


def measure(novelty: NoveltyState, states: Float[Array, "B state"]):
    """Return prediction errors, and their moments including this rollout.

    The first rollout has no past to be standardized by, so that the present counts too.
    """
    seen = novelty._replace(inputs=moments.update(novelty.inputs, states))
    errors = prediction_error(seen, novelty.predictor.params, states)
    return errors, moments.update(novelty.errors, errors)


def prediction_error(
    novelty: NoveltyState, params: dict, states: Float[Array, "B state"]
) -> Float[Array, " B"]:
    """Return the mean squared error of the predictor for each state."""
    x = moments.standardize(novelty.inputs, states, CLIP)
    error = apply(PREDICTOR, params, x) - apply(TARGET, novelty.target, x)
    return (error**2).mean(-1)
