"""Coefficients that change with what is solved."""

from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.exploration.frontier_config import FrontierConfig
from hmasd_jax.exploration.successes import NO_IMITATION, ImitationConfig
from hmasd_jax.hmasd import algorithm
from hmasd_jax.hmasd.coefficients import (
    coordinator_step_factor,
    high_entropy_coef,
    low_entropy_coef,
    sample_weight,
    skill_weight,
    unknown_share,
)
from hmasd_jax.hmasd.components import make_parts
from hmasd_jax.hmasd.config import SolvedSkillsConfig
from hmasd_jax.hmasd.distance import DistanceConfig
from tests.helpers.algorithms import lower_all


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


@pytest.fixture
def half_solved(parts):
    """Parts whose bonus state is the share of unsolved episodes, one half, and that state.

    The chance that all four copies win is 1 / 16.
    """
    config = replace(
        parts.config, extrinsic_coef=8.0, high_entropy_coef=0.1, frontier=FrontierConfig(coef=1.0),
        num_skills=4, solved=SolvedSkillsConfig(skill_gain=24.0, high_entropy_coef=3.2),
    )  # fmt: skip
    bonus = parts.bonus._replace(unsolved=lambda share, copies=True: share)
    return replace(parts, config=config, bonus=bonus), jnp.float32(0.5)


def test_skills_gain_weight_with_what_a_solved_task_pays(half_solved):
    """A chance of 1 / 16 that all copies win, at 0.25 a step and lambda_e 8: 1 + 24 / 16 x 2."""
    team_reward = jnp.array([[0.0, 1.0], [0.0, 0.0]])
    unknown = unknown_share(jnp.full((4, 2), -jnp.log(4.0)), None, 4)
    assert_allclose(skill_weight(*half_solved, team_reward, unknown), 4.0)
    assert_allclose(skill_weight(*half_solved, -team_reward, unknown), 1.0)
    assert_allclose(high_entropy_coef(*half_solved), 0.3)


def test_skills_gain_weight_by_what_q_d_does_not_know(half_solved):
    """q_d gives one skill of two agents for sure and knows nothing of the other's: a half."""
    team_reward = jnp.array([[0.0, 1.0], [0.0, 0.0]])
    log_q = jnp.tile(jnp.log(jnp.array([1.0, 0.25])), (4, 1))
    half, nothing = (unknown_share(x, None, 4) for x in (log_q, jnp.zeros((4, 2))))
    assert_allclose(skill_weight(*half_solved, team_reward, half), 1 + 3 / 2)
    assert_allclose(skill_weight(*half_solved, team_reward, nothing), 1.0)


def test_samples_are_balanced_as_the_task_is_solved(half_solved):
    """A chance of 1 / 16 that all copies win. Two of three agents' samples have the same pair."""
    parts, state = half_solved
    skills = jnp.array([[0, 1, 1, 0]])
    config = replace(parts.config, solved=SolvedSkillsConfig(balance=0.8))
    weight = sample_weight(replace(parts, config=config), state, skills)
    whole = np.array([[0.75, 0.75, 1.5]])
    assert_allclose(weight, 1 + 0.8 / 16 * (whole - 1), rtol=1e-6)
    assert sample_weight(parts, state, skills) is None


@pytest.mark.parametrize(
    ("q", "num_skills", "expected"),
    [(0.25, 4, 1.0), (0.5, 4, 0.5), (1.0, 4, 0.0), (0.01, 4, 1.0), (1.0, 1, 0.0)],
)
def test_what_q_knows_is_measured_against_chance(q, num_skills, expected):
    """A q that is sure of the wrong skill knows nothing, and no less."""
    log_q = jnp.log(jnp.full((3, 2), q))
    assert_allclose(unknown_share(log_q, None, num_skills), expected, atol=1e-6)


def test_what_q_knows_of_rare_skills_counts_as_much():
    """q is sure of the skill of three samples, and knows nothing of that of the fourth."""
    log_q = jnp.array([[0.0], [0.0], [0.0], [-jnp.log(4.0)]])
    weight = jnp.array([[2 / 3], [2 / 3], [2 / 3], [2.0]])
    assert_allclose(unknown_share(log_q, weight, 4), 0.5, rtol=1e-6)
    assert_allclose(unknown_share(log_q, None, 4), 0.25, rtol=1e-6)


def test_without_the_settings_nothing_is_traced(half_solved):
    """A constant that becomes traced rounds the whole update differently."""
    parts, state = half_solved
    config = replace(parts.config, solved=SolvedSkillsConfig())
    parts = replace(parts, config=config)
    assert type(skill_weight(parts, state, jnp.ones((2, 2)), 1.0)) is float
    assert type(high_entropy_coef(parts, state)) is float
    assert type(coordinator_step_factor(parts, state)) is float


@pytest.mark.parametrize(("unsolved", "factor"), [(1.0, 1.0), (0.5, 0.55), (0.0, 0.1)])
def test_steps_of_the_coordinator_shorten_as_episodes_are_solved(half_solved, unsolved, factor):
    parts, _ = half_solved
    solved = SolvedSkillsConfig(coordinator_step_factor=0.1)
    parts = replace(parts, config=replace(parts.config, solved=solved))
    assert_allclose(coordinator_step_factor(parts, jnp.float32(unsolved)), factor, rtol=1e-6)


@pytest.mark.parametrize(
    ("level", "other", "name"),
    [
        ("coordinator", "discoverer", "coordinator_step_factor"),
        ("discoverer", "coordinator", "step_factor"),
    ],
)
def test_a_factor_of_zero_stops_its_level_alone(parts, trained, level, other, name):
    """Adam's moments, the normalizers and the other learners go on. Imitation stops, too."""

    def update(factor):
        solved = SolvedSkillsConfig(**{name: factor})
        config = replace(parts.config, frontier=FrontierConfig(coef=1.0), solved=solved)
        bonus = parts.bonus._replace(unsolved=lambda _: jnp.float32(0))
        imitation = NO_IMITATION._replace(train=lower_all)
        changed = replace(parts, config=config, bonus=bonus, imitation=imitation)
        return jax.jit(lambda state: algorithm.train_iteration(changed, state)[0])(trained)

    stopped, plain = update(0.0), update(1.0)
    before, held, moved = (getattr(state, level) for state in (trained, stopped, plain))
    chex.assert_trees_all_equal(held.params, before.params)
    for same in (other, "discriminators", "coordinator_norm", "discoverer_norm"):
        chex.assert_trees_all_close(
            getattr(stopped, same), getattr(plain, same), rtol=1e-4, atol=1e-5
        )
    with pytest.raises(AssertionError):
        chex.assert_trees_all_close(held.opt_state, before.opt_state, rtol=1e-4)
    with pytest.raises(AssertionError):
        chex.assert_trees_all_close(held.params, moved.params, atol=1e-4)


def entropy_weight(parts, num_updates, bonus_state=(), unknown=1.0, **changes):
    """Return lambda_l after a number of updates, with other settings."""
    parts = replace(parts, config=replace(parts.config, low_entropy_coef=0.4, **changes))
    return low_entropy_coef(parts, bonus_state, jnp.int32(num_updates), unknown)


def test_the_low_entropy_weight_can_fall_linearly_to_zero(parts):
    values = [entropy_weight(parts, n, low_entropy_decay_updates=4) for n in (0, 1, 3, 4, 9)]
    assert_allclose(values, [0.4, 0.3, 0.1, 0.0, 0.0], atol=1e-6)
    assert entropy_weight(parts, 9, low_entropy_decay_updates=0) == 0.4


def test_the_low_entropy_weight_falls_with_that_of_the_bonus(parts):
    counting = replace(parts, bonus=parts.bonus._replace(entropy_weight=lambda share: share))
    assert_allclose(entropy_weight(counting, 9, jnp.float32(0.25)), 0.1)
    half = entropy_weight(counting, 2, jnp.float32(0.25), low_entropy_decay_updates=4)
    assert_allclose(half, 0.05)


def test_the_low_entropy_weight_falls_below_zero_once_all_copies_succeed(half_solved):
    """A chance of 1 / 16 that all copies win, of which sampling loses a half more."""
    parts, state = half_solved
    shares = jnp.array([0.125, 0.625, 0.625, 0.625])
    bonus = parts.bonus._replace(unsolved=lambda _, copies=True: shares.mean(where=copies))
    parts = replace(parts, bonus=bonus)
    changes = {
        "solved": SolvedSkillsConfig(sharpening=16.0),
        "imitation": ImitationConfig(greedy_copies=1),
    }
    assert_allclose(entropy_weight(parts, 9, state, **changes), 0.4 - 0.5, rtol=1e-6)
    half = entropy_weight(parts, 2, state, low_entropy_decay_updates=4, **changes)
    assert_allclose(half, -0.05, rtol=1e-6)
    assert type(entropy_weight(parts, 9, state)) is float


def test_the_low_entropy_weight_grows_by_what_q_d_does_not_know_of_a_solved_task(half_solved):
    """A chance of 1 / 16 that all copies win, and q_d knows three quarters."""
    values = [
        entropy_weight(*order, solved=SolvedSkillsConfig(low_entropy_coef=1.6))
        for order in ((half_solved[0], 9, half_solved[1], 0.25), (half_solved[0], 9, 1.0, 1.0))
    ]
    assert_allclose(values, [0.4 + 1.6 / 16 / 4, 0.4], rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("skill_gain", 2.0),
        ("low_entropy_coef", 2.0),
        ("high_entropy_coef", 2.0),
        ("sharpening", 2.0),
        ("random_share", 0.5),
        ("balance", 0.5),
        ("coordinator_step_factor", 0.5),
        ("step_factor", 0.5),
    ],
)
def test_what_changes_on_solved_tasks_needs_to_know_them(config, name, value):
    with pytest.raises(ValueError, match=rf"solved.{name} {value} needs frontier.coef above 0"):
        replace(config, solved=SolvedSkillsConfig(**{name: value}))


def test_a_gain_needs_what_it_is_measured_by(config):
    solved = SolvedSkillsConfig(skill_gain=2.0)
    with pytest.raises(ValueError, match=r"solved.skill_gain 2.0 needs extrinsic_coef above 0"):
        replace(config, solved=solved, frontier=FrontierConfig(coef=1.0), extrinsic_coef=0.0)
