"""Skills gain weight once the task is solved."""

from dataclasses import replace
from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.exploration.frontier import FrontierConfig
from hmasd_jax.hmasd import algorithm
from hmasd_jax.hmasd.components import make_parts
from hmasd_jax.hmasd.distance import DistanceConfig


def test_a_solved_task_raises_all_that_keeps_skills_apart(parts, monkeypatch):
    """A weight of 3 trains like three times the rewards for skills and lambda_h."""

    def update(scale, weight):
        config = replace(
            parts.config,
            high_entropy_coef=scale * 0.1,
            team_intrinsic_coef=scale * 0.2,
            individual_intrinsic_coef=scale * 0.3,
            distance=DistanceConfig(scale * 0.4, scale * 0.5, epochs=1),
            extrinsic_coef=7.0,
        )
        monkeypatch.setattr(algorithm, "skill_weight", lambda *_: weight)
        monkeypatch.setattr(algorithm, "high_entropy_coef", lambda *_: weight * scale * 0.1)
        changed = make_parts(parts.env, config)
        state = algorithm.init_state(changed, jax.random.key(0))
        state, _ = jax.jit(lambda state: algorithm.train_iteration(changed, state))(state)
        return state.coordinator.params, state.discoverer.params, state.distance

    raised, scaled, plain = update(1.0, 3.0), update(3.0, 1.0), update(1.0, 1.0)
    chex.assert_trees_all_close(raised, scaled, rtol=1e-4, atol=1e-5)
    for raised_level, plain_level in zip(raised[:2], plain[:2]):
        with pytest.raises(AssertionError):
            chex.assert_trees_all_close(raised_level, plain_level, rtol=0, atol=1e-3)


def test_skills_gain_weight_with_what_a_solved_task_pays(parts):
    """Half of the chance to be at the best, at 0.25 a step and lambda_e 8: 1 + 3 x 0.5 x 2."""
    config = replace(
        parts.config, extrinsic_coef=8.0, high_entropy_coef=0.1, frontier=FrontierConfig(coef=1.0),
        solved_gain=3.0, solved_entropy_coef=0.4,
    )  # fmt: skip
    parts = replace(parts, config=config, bonus=parts.bonus._replace(solved=lambda share: share))
    state = SimpleNamespace(bonus=jnp.float32(0.5))
    team_reward = jnp.array([[0.0, 1.0], [0.0, 0.0]])
    assert_allclose(algorithm.skill_weight(parts, state, team_reward), 4.0)
    assert_allclose(algorithm.skill_weight(parts, state, -team_reward), 1.0)
    assert_allclose(algorithm.high_entropy_coef(parts, state), 0.3)


def test_without_the_settings_nothing_is_traced(parts):
    """A constant that becomes traced rounds the whole update differently."""
    config = replace(parts.config, frontier=FrontierConfig(coef=1.0))
    parts = replace(parts, config=config, bonus=parts.bonus._replace(solved=lambda share: share))
    state = SimpleNamespace(bonus=jnp.float32(0.5))
    assert type(algorithm.skill_weight(parts, state, jnp.ones((2, 2)))) is float
    assert type(algorithm.high_entropy_coef(parts, state)) is float


@pytest.mark.parametrize("name", ["solved_gain", "solved_entropy_coef"])
def test_what_rises_on_solved_tasks_needs_to_know_them(config, name):
    with pytest.raises(ValueError, match=rf"{name} 2.0 needs frontier.coef above 0"):
        replace(config, **{name: 2.0})
