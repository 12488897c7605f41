"""The classifier that tells skills apart, on skills that differ and skills that do not."""

import jax
import numpy as np
import pytest

from scripts import skill_accuracy

SKILLS, EPISODES, STEPS, AGENTS = 4, 16, 20, 2


@pytest.fixture(autouse=True)
def _few_steps(monkeypatch):
    monkeypatch.setattr(skill_accuracy, "GRADIENT_STEPS", 300)
    monkeypatch.setattr(skill_accuracy, "BATCH", 64)


def accuracy(shift, counted=None, length=1):
    """Return the accuracy where skill z moves feature z of the observations by `shift`."""
    key = jax.random.key(0)
    obs = np.random.default_rng(0).normal(size=(SKILLS, EPISODES, STEPS, AGENTS, SKILLS))
    obs = obs + shift * np.eye(SKILLS)[:, None, None, None]
    if counted is None:
        counted = np.ones(obs.shape[:-1], bool)
    segments = (skill_accuracy.cut(x, length) for x in (obs, counted))
    return skill_accuracy.classify(*segments, 16, key)


def test_skills_that_differ_are_told_apart():
    assert accuracy(shift=10.0) > 0.95


def test_equal_skills_are_guessed():
    assert accuracy(shift=0.0) == pytest.approx(1 / SKILLS, abs=0.1)


def test_skills_that_are_held_longer_are_no_easier_to_guess():
    counted = np.ones((SKILLS, EPISODES, STEPS, AGENTS), bool)
    counted[1:, :, 4:] = False
    assert accuracy(shift=0.0, counted=counted) == pytest.approx(1 / SKILLS, abs=0.1)


def test_segments_tell_more_than_their_steps():
    assert accuracy(shift=1.0) < 0.7
    assert accuracy(shift=1.0, length=10) > 0.9


@pytest.mark.parametrize("length", [1, 10])
def test_steps_after_the_end_of_an_episode_do_not_count(length):
    """Count only steps of skill 0, which is then always right."""
    counted = np.zeros((SKILLS, EPISODES, STEPS, AGENTS), bool)
    counted[0, :, :3] = True
    assert accuracy(shift=0.0, counted=counted, length=length) == 1


def test_steps_that_do_not_count_tell_nothing():
    obs = np.random.default_rng(0).normal(size=(SKILLS, EPISODES, 1, STEPS, SKILLS))
    counted = np.ones(obs.shape[:-1], bool)
    counted[..., 5:] = False
    obs[..., 5:, :] += 10 * np.eye(SKILLS)[:, None, None, None]
    told = skill_accuracy.classify(obs, counted, 16, jax.random.key(0))
    assert told == pytest.approx(1 / SKILLS, abs=0.15)


def test_segments_follow_one_agent():
    x = np.arange(2 * 3 * 7 * 2).reshape(2, 3, 7, 2)
    segments = skill_accuracy.cut(x, 3)
    assert segments.shape == (2, 3, 4, 3)
    assert segments[1, 2].tolist() == [
        x[1, 2, start : start + 3, agent].tolist() for start in (0, 3) for agent in (0, 1)
    ]
