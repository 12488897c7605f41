"""The skill discriminators q_D(Z|s) and q_d(z^i|o^i, Z) (Sec. 3.2, Eq. 8)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float, Int

from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.networks.layer_norm import NormedDense
from hmasd_jax.networks.recurrent import MLP, SMALL_GAIN, apply
from hmasd_jax.types import Key, Metrics

LARGEST_WEIGHT = 10.0
"""Bound of a sample's weight in the loss of q_d, before weights are scaled to a mean of 1."""


class Classifier(nn.Module):
    """MLP and linear head. The small gain of the head makes the first predictions uniform."""

    num_classes: int
    hidden_size: int

    @nn.compact
    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch classes"]:
        """Return log-probabilities of the classes."""
        mlp = MLP(self.hidden_size)
        head = NormedDense(self.num_classes, SMALL_GAIN, mlp.output_norm, name="head")
        return jax.nn.log_softmax(head(mlp(x)))


class Discriminators(NamedTuple):
    """The two networks. Parameters are a dict with the same names."""

    team: Classifier
    individual: Classifier


class SkillPair(NamedTuple):
    """Samples of D: the states and observations reached under skills."""

    state: Float[Array, "*batch state"]
    """s_{t+1}."""
    obs: Float[Array, "*batch N obs"]
    """o_{t+1}."""
    skills: Int[Array, "*batch tokens"]
    """Z, then z^1..z^N."""
    weight: Float[Array, "*batch N"] | None = None
    """Weights of mean 1 in the loss of q_d; None if all samples weigh alike."""


def make_discriminators(config: HMASDConfig) -> Discriminators:
    """Build feed-forward classifiers of team skills and of individual skills."""
    size = config.ppo.hidden_size
    return Discriminators(
        team=Classifier(config.num_team_skills, size),
        individual=Classifier(config.num_skills, size),
    )


def center(x: Float[Array, "*batch features"]) -> Float[Array, "*batch features"]:
    """Shift each feature to mean 0 over the batch, and scale all to a mean variance of 1.

    All features share one scale: distant inputs stay distant, and a feature that hardly ever
    changes stays small.
    """
    batch = tuple(range(x.ndim - 1))
    return (x - x.mean(batch)) * jax.lax.rsqrt(x.var(batch).mean() + 1e-8)


def blur(
    x: Float[Array, "*batch features"], noise: float, key: Key
) -> Float[Array, "*batch features"]:
    """Add Gaussian noise with a standard deviation drawn from [0, `noise`] for each sample.

    Samples with little noise separate skills that are close together. Samples with much noise keep
    rewarding skills that move further apart.
    """
    key_scale, key_noise = jax.random.split(key)
    scale = jax.random.uniform(key_scale, (*x.shape[:-1], 1), maxval=noise)
    return x + scale * jax.random.normal(key_noise, x.shape)


def observe(pair: SkillPair, config: HMASDConfig, key: Key) -> SkillPair:
    """Select and transform the inputs of the discriminators: by default, all of them unchanged."""
    state, obs = pair.state, pair.obs
    if config.discriminator_obs:
        obs = obs[..., jnp.array(config.discriminator_obs)]
    if config.discriminator_center:
        state, obs = center(state), center(obs)
    if config.discriminator_noise > 0:
        key_state, key_obs = jax.random.split(key)
        state = blur(state, config.discriminator_noise, key_state)
        obs = blur(obs, config.discriminator_noise, key_obs)
    return pair._replace(state=state, obs=obs)


def balance(skills: Int[Array, "*batch tokens"], config: HMASDConfig) -> Float[Array, "*batch N"]:
    """Return weights of mean 1 with which all pairs (Z, z^i) in use have the same total.

    The weight of a rare pair is bounded.
    """
    num_pairs = config.num_team_skills * config.num_skills
    pair = jax.nn.one_hot(skills[..., :1] * config.num_skills + skills[..., 1:], num_pairs)
    share = pair.mean(tuple(range(pair.ndim - 1)))
    weight = pair @ (1.0 / jnp.maximum(num_pairs * share, 1.0 / LARGEST_WEIGHT))
    return weight / weight.mean()


def weigh(
    log_q: Float[Array, "*batch N"], weight: Float[Array, "*batch N"] | None
) -> Float[Array, "*batch N"]:
    """Multiply log q_d by the weights of its samples."""
    return log_q if weight is None else log_q * weight


def log_q(
    params: dict, networks: Discriminators, pair: SkillPair
) -> tuple[Float[Array, "*batch team_skills"], Float[Array, "*batch N skills"]]:
    """Return log q_D(.|s) and log q_d(.|o^i, Z) over all skills."""
    team = apply(networks.team, params["team"], pair.state)
    team_skill = jax.nn.one_hot(pair.skills[..., :1], networks.team.num_classes)
    team_skill = jnp.broadcast_to(team_skill, (*pair.obs.shape[:-1], team_skill.shape[-1]))
    inputs = jnp.concatenate([pair.obs, team_skill], axis=-1)
    return team, apply(networks.individual, params["individual"], inputs)


def _in_use(
    values: Float[Array, "*batch skills"], skill: Int[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Pick the values of `skill` by a mask, which compiles faster than indexing."""
    return jnp.where(jax.nn.one_hot(skill, values.shape[-1], dtype=bool), values, 0.0).sum(-1)


def log_q_of_skills(
    params: dict, networks: Discriminators, pair: SkillPair
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch N"], Metrics]:
    """Return log q_D(Z|s) and log q_d(z^i|o^i, Z) of the skills in use, and accuracies."""
    team, individual = log_q(params, networks, pair)
    Z, z = pair.skills[..., 0], pair.skills[..., 1:]  # noqa: N806 (the paper's symbols)
    metrics = {
        "team_accuracy": (team.argmax(-1) == Z).mean(),
        "individual_accuracy": (individual.argmax(-1) == z).mean(),
    }
    team, individual = _in_use(team, Z), _in_use(individual, z)
    metrics |= {"log_q_team": team.mean(), "log_q_individual": individual.mean()}
    return team, individual, metrics


def discriminator_loss(
    params: dict, networks: Discriminators, pair: SkillPair
) -> tuple[Float[Array, ""], Metrics]:
    """Eq. 8: L_d = -E[log q_D(Z|s)] - sum_i E[log q_d(z^i|o^i, Z)] over the current rollout.

    The sum over agents is a mean, like in the authors' code, weighted if skills are balanced.
    """
    team, individual, _ = log_q_of_skills(params, networks, pair)
    individual = weigh(individual, pair.weight)
    metrics = {"team_loss": -team.mean(), "individual_loss": -individual.mean()}
    return metrics["team_loss"] + metrics["individual_loss"], metrics
