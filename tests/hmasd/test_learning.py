"""HMASD learns tiny tasks, each of which needs one of its parts to work."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_jax.probes import DifferentActions, HiddenCue, RememberCue
from hmasd_jax.hmasd import algorithm as algorithm_module
from hmasd_jax.hmasd.algorithm import make_hmasd
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.rl.ppo import PPOConfig


def _config(learning_rate=3e-3, **fields):
    ppo = PPOConfig(
        num_envs=16,
        rollout_length=20,
        sequence_length=5,
        num_epochs=5,
        hidden_size=16,
        learning_rate=learning_rate,
    )
    defaults = {
        "skill_interval": 4, "num_team_skills": 1, "num_skills": 2, "discriminator_epochs": 5,
        "discriminate": "outcome",
    }  # fmt: skip
    return HMASDConfig(**defaults | fields, ppo=ppo)


def _train(env, config, obedient=False):
    """Metrics of 100 updates. Obedient agents do not learn: skill z means action z, always."""
    algorithm = make_hmasd(env, config)
    state = jax.jit(algorithm.init)(jax.random.key(0))

    def update(state, _):
        if obedient:
            state = state._replace(discoverer=_obey(state.discoverer))
        return algorithm.update(state)

    run = jax.jit(lambda state: jax.lax.scan(update, state, None, 100)[1])
    return jax.tree.map(np.asarray, run(state))


def _obey(discoverer):
    """The actor's head sees the skill last; let it see nothing else."""
    actor = discoverer.params["actor"]["params"]
    kernel = actor["head"]["kernel"]
    kernel = jnp.concatenate([jnp.zeros_like(kernel[:-2]), 20.0 * jnp.eye(2)])
    actor = {**actor, "head": {"kernel": kernel, "bias": jnp.zeros(2)}}
    return discoverer._replace(params={**discoverer.params, "actor": {"params": actor}})


def test_the_discoverer_learns_to_remember_a_cue_from_the_team_reward():
    # One step of five is paid: 1/5 a step, without a memory across steps 1/10.
    config = _config(
        coordinator="random",
        skill_interval=5,
        extrinsic_coef=1.0,
        team_intrinsic_coef=0.0,
        individual_intrinsic_coef=0.0,
    )
    metrics = _train(RememberCue(), config)
    assert metrics["team_reward"][:5].mean() < 0.12
    assert metrics["team_reward"][-5:].mean() > 0.19


@pytest.mark.parametrize("env", [HiddenCue(), DifferentActions()], ids=lambda e: type(e).__name__)
def test_the_coordinator_learns_to_lead_obedient_agents(env):
    # At most 1 a step, and 1/2 on average if skills do not depend on the state (first task) or
    # not on the skills before them (second task). Without the guard it falls back after perfect
    # rollouts: every segment is paid the same, and normalized advantages are noise.
    config = _config(learning_rate=1e-3, high_entropy_coef=0.05, zero_reward_guard=True)
    metrics = _train(env, config, obedient=True)
    assert metrics["team_reward"][:5].mean() < 0.6
    assert metrics["team_reward"][-5:].mean() > 0.95


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
    metrics = _train(HiddenCue(), _config(coordinator="random"))
    match = metrics["discriminators/match"]
    assert 0.4 < match[0] < 0.6
    assert match[-5:].mean() > 0.9


def test_discriminators_and_discoverer_agree_on_skills_from_nothing():
    metrics = _train(HiddenCue(), _config(coordinator="random"))
    accuracy = metrics["discriminators/individual_accuracy"]
    assert accuracy[0] < 0.65
    assert accuracy[-5:].mean() > 0.85
