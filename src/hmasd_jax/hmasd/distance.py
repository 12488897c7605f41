"""Reward for skills that lead far apart: METRA (Park et al., ICLR 2024) for teams of agents.

phi maps observations to one dimension per skill such that one step moves it by at most 1 per
dimension, as a root mean square. A skill is paid for the distance it moves along its own direction,
so that the best skills travel far, not merely apart from each other. The directions of all skills
sum to 0: an untrained phi pays nothing on average, and standing still pays 0.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jaxtyping import Array, Float, Int

from envs_jax import Environment
from hmasd_jax.networks.recurrent import RELU_GAIN, apply, dense
from hmasd_jax.rl import moments
from hmasd_jax.rl.moments import Moments
from hmasd_jax.rl.sgd import sgd_epochs
from hmasd_jax.types import Key, Learner, Metrics
from hmasd_jax.validation import check_range, check_types

CLIP = 3.0
"""Largest standardized input."""
SLACK = 1e-3
"""Part of the constraint that need not be tight (epsilon of METRA)."""
FIRST_MULTIPLIER = 30.0
"""Initial Lagrange multiplier (METRA)."""
HIDDEN = 64


@dataclass(frozen=True)
class DistanceConfig:
    """Settings of the reward."""

    individual_coef: float = 0.0
    """Weight of each agent's distance along its skill z^i. A step of usual length pays at most
    about n / sqrt(n - 1) before the weight, for n skills."""
    team_coef: float = 0.0
    """Weight of the state's distance along the team skill Z. With both weights 0 nothing is
    learned."""
    epochs: int = 10
    """Gradient steps per rollout on phi, the network whose outputs measure distance. Each step uses
    the whole rollout."""
    learning_rate: float = 5e-4
    """Step size of Adam for phi and the multipliers."""

    def __post_init__(self) -> None:
        check_types(self)
        check_range(self, "individual_coef", "team_coef", "learning_rate", low=0)
        check_range(self, "epochs", low=1)


class SkillSteps(NamedTuple):
    """Steps of a rollout: start, end, and the skills in use."""

    state: Float[Array, "B state"]
    obs: Float[Array, "B N obs"]
    next_state: Float[Array, "B state"]
    """State after the step, before any reset."""
    next_obs: Float[Array, "B N obs"]
    skills: Int[Array, "B tokens"]
    """Z, then z^1..z^N."""


class DistanceState(NamedTuple):
    """State of the reward."""

    learner: Learner
    """Parameters of both phi, and log of their Lagrange multipliers."""
    states: Moments
    """Moments of the global states so far."""
    obs: Moments
    """Moments of the observations so far."""


class SkillReward(NamedTuple):
    """A reward for skills as three pure functions."""

    init: Callable[[Key], Any]
    """`init(key)`: state before the first rollout."""
    reward: Callable[[Any, SkillSteps], tuple[Float[Array, " B"], Float[Array, "B N"], Metrics]]
    """`reward(reward_state, steps)`: weighted rewards of the team and of each agent."""
    train: Callable[[Any, SkillSteps, Key], tuple[Any, Metrics]]
    """`train(reward_state, steps, key)`: learn from the steps of a rollout."""


NO_REWARD = SkillReward(
    init=lambda key: (),
    reward=lambda reward_state, steps: (
        jnp.zeros(steps.state.shape[:-1]), jnp.zeros(steps.obs.shape[:-1]), {}
    ),
    train=lambda reward_state, steps, key: (reward_state, {}),
)  # fmt: skip


class Embedding(nn.Module):
    """phi: a ReLU network with one output per skill."""

    num_skills: int

    @nn.compact
    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch skills"]:
        """Embed standardized inputs."""
        for _ in range(2):
            x = nn.relu(dense(HIDDEN, RELU_GAIN)(x))
        return dense(self.num_skills, 1.0)(x)


def make_distance(
    env: Environment, num_team_skills: int, num_skills: int, config: DistanceConfig
) -> SkillReward:
    """Build the reward for `env`.

    Args:
        env: Environment that gives the sizes of state and observation.
        num_team_skills: n_Z.
        num_skills: n_z.
        config: Weights and optimization. With both weights 0 the part pays and learns nothing.
    """
    if config.individual_coef == config.team_coef == 0:
        return NO_REWARD
    networks = {"team": Embedding(num_team_skills), "individual": Embedding(num_skills)}
    optimizer = optax.adam(config.learning_rate)

    def init(key: Key) -> DistanceState:
        key_team, key_individual = jax.random.split(key)
        params = {
            "team": networks["team"].init(key_team, jnp.zeros((1, env.state_dim))),
            "individual": networks["individual"].init(key_individual, jnp.zeros((1, env.obs_dim))),
            "log_multiplier": dict.fromkeys(networks, jnp.log(jnp.float32(FIRST_MULTIPLIER))),
        }
        return DistanceState(
            learner=Learner(params, optimizer.init(params)),
            states=Moments.create(env.state_dim),
            obs=Moments.create(env.obs_dim),
        )

    def reward(distance: DistanceState, steps: SkillSteps):
        seen = observe(distance, steps)
        moved = movements(networks, distance.learner.params, seen, steps)
        team, individual = (
            along(moved[name], skills, networks[name].num_skills)
            for name, skills in skills_of(steps).items()
        )
        metrics = {"distance_team": team.mean(), "distance_individual": individual.mean()}
        return config.team_coef * team, config.individual_coef * individual, metrics

    def train(distance: DistanceState, steps: SkillSteps, key: Key):
        seen = observe(distance, steps)

        def step(learner, steps):
            grads, metrics = jax.grad(distance_loss, has_aux=True)(
                learner.params, networks, seen, steps
            )
            updates, opt_state = optimizer.update(grads, learner.opt_state)
            return Learner(optax.apply_updates(learner.params, updates), opt_state), metrics

        learner, metrics = sgd_epochs(step, distance.learner, steps, key, config.epochs, 1)
        return seen._replace(learner=learner), metrics

    return SkillReward(init, reward, train)


def observe(distance: DistanceState, steps: SkillSteps) -> DistanceState:
    """Update the moments with a rollout."""
    return distance._replace(
        states=moments.update(distance.states, steps.next_state),
        obs=moments.update(distance.obs, steps.next_obs),
    )


def skills_of(steps: SkillSteps) -> dict[str, Array]:
    """Return the skills of team and agents by the names of their networks."""
    return {"team": steps.skills[..., 0], "individual": steps.skills[..., 1:]}


def movements(
    networks: dict, params: dict, seen: DistanceState, steps: SkillSteps
) -> dict[str, Array]:
    """Return phi(s') - phi(s) of the team and phi(o') - phi(o) of each agent."""

    def moved(name, norm, before, after):
        before, after = (moments.standardize(norm, x, CLIP) for x in (before, after))
        phi = networks[name]
        return apply(phi, params[name], after) - apply(phi, params[name], before)

    return {
        "team": moved("team", seen.states, steps.state, steps.next_state),
        "individual": moved("individual", seen.obs, steps.obs, steps.next_obs),
    }


def along(
    moved: Float[Array, "*batch skills"], skill: Int[Array, "*batch"], num_skills: int
) -> Float[Array, "*batch"]:
    """Project movements on (one-hot z - 1/n) n / (n - 1), the direction of a skill."""
    direction = (jax.nn.one_hot(skill, num_skills) - 1 / num_skills) * num_skills
    return (moved * direction).sum(-1) / max(num_skills - 1, 1)


def distance_loss(
    params: dict, networks: dict, seen: DistanceState, steps: SkillSteps
) -> tuple[Float[Array, ""], Metrics]:
    """Return the loss of phi and of the multipliers (METRA, Eq. 9 with dual gradient descent).

    phi maximizes the reward under the constraint that the mean squared movement per dimension is
    at most 1. Each multiplier grows while its constraint is violated.
    """
    loss, metrics = jnp.float32(0), {}
    moved, skills = movements(networks, params, seen, steps), skills_of(steps)
    for name, network in networks.items():
        reward = along(moved[name], skills[name], network.num_skills).mean()
        constraint = jnp.minimum(1.0 - (moved[name] ** 2).mean(-1), SLACK).mean()
        log_multiplier = params["log_multiplier"][name]
        multiplier = jax.lax.stop_gradient(jnp.exp(log_multiplier))
        loss -= reward + multiplier * constraint
        loss += log_multiplier * jax.lax.stop_gradient(constraint)
        metrics |= {f"multiplier_{name}": multiplier, f"constraint_{name}": constraint}
    return loss, metrics
