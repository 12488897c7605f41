"""The classifier that tells skills apart, on skills that differ and skills that do not."""

import jax
import jax.numpy as jnp
import pytest

from scripts import skill_accuracy

SKILLS, EPISODES, STEPS = 4, 8, 10


@pytest.fixture(autouse=True)
def _few_steps(monkeypatch):
    monkeypatch.setattr(skill_accuracy, "GRADIENT_STEPS", 300)
    monkeypatch.setattr(skill_accuracy, "BATCH", 64)


def accuracy(shift, counted=None):
    """Return the accuracy where skill z moves feature z of the observations by `shift`."""
    key, key_obs = jax.random.split(jax.random.key(0))
    skills = jnp.arange(SKILLS)
    obs = jax.random.normal(key_obs, (SKILLS, EPISODES, STEPS, SKILLS))
    obs = obs + shift * jax.nn.one_hot(skills, SKILLS)[:, None, None]
    if counted is None:
        counted = jnp.ones(obs.shape[:-1], bool)
    return skill_accuracy.classify(obs, counted, skills, 16, key)


def test_skills_that_differ_are_told_apart():
    assert accuracy(shift=10.0) > 0.95


def test_equal_skills_are_guessed():
    assert accuracy(shift=0.0) == pytest.approx(1 / SKILLS, abs=0.1)


def test_steps_after_the_end_of_an_episode_do_not_count():
    """Count only steps of skill 0, which is then always right."""
    counted = jnp.zeros((SKILLS, EPISODES, STEPS), bool).at[0].set(True)
    assert accuracy(shift=0.0, counted=counted) == 1
