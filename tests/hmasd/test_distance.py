"""The distance reward: its projection by hand, its constraint, and that it finds far ends."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import envs_jax
from hmasd_jax.hmasd.distance import (
    NO_REWARD,
    DistanceConfig,
    SkillSteps,
    along,
    make_distance,
)

ENV = envs_jax.make("alice_and_bob")


def test_movement_counts_along_the_skills_own_direction():
    # Skill 0 of 3: (1 - 1/3, -1/3, -1/3) 3/2 = (1, -1/2, -1/2).
    moved = jnp.array([[1.0, 2.0, 4.0]])
    assert_allclose(along(moved, jnp.array([0]), 3), [1 - 1 - 2])
    # The same movement pays 0 in the mean over the skills, and nothing with one skill.
    pays = along(moved.repeat(3, 0), jnp.arange(3), 3)
    assert_allclose(pays.mean(), 0.0, atol=1e-6)
    assert_allclose(along(jnp.array([[5.0]]), jnp.array([0]), 1), [0.0])


def _line(key, size=512):
    """Skill 1 moves up the first feature, of an agent or of the state, and skill 0 down."""
    key_z, key_x, key_o = jax.random.split(key, 3)
    skills = jax.random.randint(key_z, (size, 1 + ENV.num_agents), 0, 2)
    obs = 0.01 * jax.random.normal(key_o, (size, ENV.num_agents, ENV.obs_dim))
    obs = obs.at[:, :, 0].set(jax.random.uniform(key_x, (size, ENV.num_agents), minval=-1))
    state = 0.01 * jax.random.normal(key_o, (size, ENV.state_dim))
    state = state.at[:, 0].set(10 * jax.random.uniform(key_x, (size,), minval=-1))
    step = 0.2 * (2.0 * skills - 1.0)
    next_state = state.at[:, 0].add(10 * step[:, 0])
    return SkillSteps(state, obs, next_state, obs.at[:, :, 0].add(step[:, 1:]), skills)


@pytest.fixture(scope="module")
def learned():
    part = make_distance(ENV, 2, 2, DistanceConfig(individual_coef=2.0, team_coef=1.0))

    @jax.jit
    def train(key):
        def step(state, key):
            key_data, key_train = jax.random.split(key)
            return part.train(state, _line(key_data), key_train)

        key_init, key_train = jax.random.split(key)
        return jax.lax.scan(step, part.init(key_init), jax.random.split(key_train, 150))

    state, metrics = train(jax.random.key(0))
    return part, state, metrics


def test_skills_that_move_apart_are_paid_and_swapped_skills_are_charged(learned):
    part, state, _ = learned
    steps = _line(jax.random.key(5))
    rewards = part.reward(state, steps)[:2]
    swapped = part.reward(state, steps._replace(skills=1 - steps.skills))[:2]
    for paid, charged in zip(rewards, swapped):
        assert paid.mean() > 0.5
        assert charged.mean() < -0.5
        assert_allclose(paid, -charged, atol=1e-5)


def test_each_weight_is_that_of_its_own_reward(learned):
    _, state, _ = learned
    steps = _line(jax.random.key(7))
    team, individual, _ = make_distance(ENV, 2, 2, DistanceConfig(1.0, 1.0)).reward(state, steps)
    weighted = make_distance(ENV, 2, 2, DistanceConfig(individual_coef=2.0, team_coef=3.0))
    rewards = weighted.reward(state, steps)[:2]
    assert_allclose(rewards[0], 3.0 * team, rtol=1e-5)
    assert_allclose(rewards[1], 2.0 * individual, rtol=1e-5)


def test_standing_still_pays_nothing(learned):
    part, state, _ = learned
    steps = _line(jax.random.key(6))
    still = steps._replace(next_obs=steps.obs, next_state=steps.state)
    team, individual, _ = part.reward(state, still)
    assert_allclose(individual, 0.0, atol=1e-6)
    assert_allclose(team, 0.0, atol=1e-6)


def test_one_step_moves_phi_by_at_most_about_1(learned):
    _, _, metrics = learned
    # The constraint is 1 - mean squared movement, cut at its slack; negative is violated.
    assert np.asarray(metrics["constraint_individual"])[-20:].mean() > -0.3


def test_without_weights_there_is_no_state_and_no_reward():
    part = make_distance(ENV, 2, 2, DistanceConfig())
    assert part is NO_REWARD
    assert jax.tree.leaves(part.init(jax.random.key(0))) == []
    team, individual, metrics = part.reward((), _line(jax.random.key(0), 3))
    np.testing.assert_array_equal(team, np.zeros(3))
    np.testing.assert_array_equal(individual, np.zeros((3, ENV.num_agents)))
    assert metrics == {}
