"""HMASD learns tiny tasks, each of which needs one more of its parts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_jax.probes import DifferentActions, HiddenCue, MatchCue, RememberCue
from hmasd_jax.evaluate import evaluate
from hmasd_jax.hmasd import algorithm as algorithm_module
from hmasd_jax.hmasd.algorithm import make_hmasd
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.ppo import PPOConfig


def _train(env, config, num_updates, key=0):
    """Metrics of every update, and those of 100 greedy episodes afterwards."""
    algorithm = make_hmasd(env, config)

    def run(key):
        state, metrics = jax.lax.scan(
            lambda state, _: algorithm.update(state), algorithm.init(key), None, num_updates
        )
        return metrics, evaluate(env, algorithm.policy(state), jax.random.key(1), 100)

    return jax.tree.map(np.asarray, jax.jit(run)(jax.random.key(key)))


def _config(**fields):
    ppo = {
        "num_envs": 16, "rollout_length": 20, "sequence_length": 5, "num_epochs": 5,
        "hidden_size": 16, "learning_rate": 3e-3,
    } | fields.pop("ppo", {})  # fmt: skip
    defaults = {
        "skill_interval": 4, "num_team_skills": 1, "num_skills": 2, "discriminator_epochs": 5,
        "high_entropy_coef": 0.01,
    }  # fmt: skip
    return HMASDConfig(**defaults | fields, ppo=PPOConfig(**ppo))


TEAM_REWARD_ONLY = {
    "extrinsic_coef": 1.0, "team_intrinsic_coef": 0.0, "individual_intrinsic_coef": 0.0,
}  # fmt: skip


@pytest.mark.parametrize("env", [MatchCue(), RememberCue()], ids=lambda env: type(env).__name__)
def test_the_discoverer_learns_from_the_team_reward(env):
    config = _config(skill_interval=5, **TEAM_REWARD_ONLY)
    _, result = _train(env, config, 100)
    assert result["return"] > 0.95


def test_skills_learn_to_name_a_cue_that_only_the_coordinator_sees():
    # Four steps of at most 1; what ignores the state gets 2.
    _, result = _train(HiddenCue(), _config(skill_at="last_layer"), 150)
    assert result["return"] > 3.8


def test_the_second_skill_complements_the_first():
    # Agents that nothing but their skills tells apart; independent draws get 2 of 4.
    _, result = _train(DifferentActions(), _config(), 150)
    assert result["return"] > 3.8


def test_a_fixed_discriminator_pulls_skills_apart(monkeypatch):
    # q is made by hand: it knows that a skill means the action of the same number, which the
    # observation after the step shows. Perfect skills get log 0.95, ignorant ones
    # (log 0.95 + log 0.05) / 2 = -1.52.
    def log_q_by_hand(params, networks, pair):
        done = pair.obs[..., 4:6].argmax(-1)
        match = done == pair.skills[..., 1:]
        log_q = jnp.where(match, jnp.log(0.95), jnp.log(0.05))
        return jnp.zeros(match.shape[:-1]), log_q, {"match": match.mean()}

    monkeypatch.setattr(algorithm_module, "log_q_of_skills", log_q_by_hand)
    config = _config(discriminate="outcome", individual_intrinsic_coef=0.2)
    metrics, _ = _train(HiddenCue(), config, 60)
    match = metrics["discriminators/match"]
    assert 0.4 < match[0] < 0.6
    assert match[-5:].mean() > 0.9


def test_discriminators_and_discoverer_agree_on_skills_from_nothing():
    metrics, _ = _train(HiddenCue(), _config(discriminate="outcome"), 100)
    accuracy = metrics["discriminators/individual_accuracy"]
    assert accuracy[0] < 0.65
    assert accuracy[-5:].mean() > 0.9
