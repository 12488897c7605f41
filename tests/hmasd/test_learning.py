"""HMASD learns tiny tasks, each of which needs one of its parts to work."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_jax.probes import DifferentActions, HiddenCue, RememberCue
from hmasd_jax.evaluate import evaluate
from hmasd_jax.hmasd import algorithm as algorithm_module
from hmasd_jax.hmasd.algorithm import make_hmasd
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.ppo import PPOConfig


def _config(**fields):
    ppo = PPOConfig(
        num_envs=16,
        rollout_length=20,
        sequence_length=5,
        num_epochs=5,
        hidden_size=16,
        learning_rate=3e-3,
    )
    defaults = {
        "skill_interval": 4, "num_team_skills": 1, "num_skills": 2, "discriminator_epochs": 5,
        "discriminate": "outcome",
    }  # fmt: skip
    return HMASDConfig(**defaults | fields, ppo=ppo)


def _train(env, config, num_updates, obedient=False):
    """Metrics of every update, and those of 100 greedy episodes afterwards.

    Obedient agents do not learn: skill z means action z, at every step.
    """
    algorithm = make_hmasd(env, config)

    def hold(state):
        return state._replace(discoverer=_obey(state.discoverer)) if obedient else state

    def run(key):
        state, metrics = jax.lax.scan(
            lambda state, _: algorithm.update(hold(state)), algorithm.init(key), None, num_updates
        )
        policy = algorithm.policy(hold(state))
        return metrics, evaluate(env, policy, jax.random.key(1), 100)

    return jax.tree.map(np.asarray, jax.jit(run)(jax.random.key(0)))


def _obey(discoverer):
    """The actor's head sees the skill last; let it see nothing else."""
    actor = discoverer.params["actor"]["params"]
    kernel = actor["head"]["kernel"]
    kernel = jnp.concatenate([jnp.zeros_like(kernel[:-2]), 20.0 * jnp.eye(2)])
    actor = {**actor, "head": {"kernel": kernel, "bias": jnp.zeros(2)}}
    return discoverer._replace(params={**discoverer.params, "actor": {"params": actor}})


def test_the_discoverer_learns_to_remember_a_cue_from_the_team_reward():
    # One step of five is paid; without a memory across steps it pays 1/2.
    config = _config(
        skill_interval=5,
        extrinsic_coef=1.0,
        team_intrinsic_coef=0.0,
        individual_intrinsic_coef=0.0,
    )
    _, result = _train(RememberCue(), config, 100)
    assert result["return"] > 0.95


@pytest.mark.parametrize("env", [HiddenCue(), DifferentActions()], ids=lambda e: type(e).__name__)
def test_the_coordinator_learns_to_lead_obedient_agents(env):
    # Four steps of at most 1. Skills that do not depend on the state (first task), or not on the
    # skills before them (second task), get 2 on average.
    _, result = _train(env, _config(high_entropy_coef=0.01), 60, obedient=True)
    assert result["return"] > 3.8


def test_a_fixed_discriminator_pulls_skills_apart(monkeypatch):
    # q is made by hand: it knows that a skill means the action of the same number, which the
    # observation after the step shows. Perfect skills get log 0.95, ignorant ones
    # (log 0.95 + log 0.05) / 2 = -1.52.
    def log_q_by_hand(params, networks, pair):
        action = pair.obs[..., 4:6].argmax(-1)
        match = action == pair.skills[..., 1:]
        log_q = jnp.where(match, jnp.log(0.95), jnp.log(0.05))
        return jnp.zeros(match.shape[:-1]), log_q, {"match": match.mean()}

    monkeypatch.setattr(algorithm_module, "log_q_of_skills", log_q_by_hand)
    metrics, _ = _train(HiddenCue(), _config(), 50)
    match = metrics["discriminators/match"]
    assert 0.4 < match[0] < 0.6
    assert match[-5:].mean() > 0.9


def test_discriminators_and_discoverer_agree_on_skills_from_nothing():
    metrics, _ = _train(HiddenCue(), _config(), 100)
    accuracy = metrics["discriminators/individual_accuracy"]
    assert accuracy[0] < 0.65
    assert accuracy[-5:].mean() > 0.85
