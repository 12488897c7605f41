"""Conversion of environments to PettingZoo: its own tests, and equal numbers."""

import jax
import numpy as np
import pytest

import envs_jax
from envs_jax.alice_and_bob import AliceAndBob
from envs_jax.probes import LegalAction, RememberCue, TimeLimit

pytest.importorskip("pettingzoo", reason="pettingzoo is not installed")

from pettingzoo.test import parallel_api_test, parallel_seed_test, state_test
from pettingzoo.utils.conversions import parallel_to_aec

ENVS = [AliceAndBob(max_steps=12), LegalAction(), RememberCue(), TimeLimit()]
by_class = pytest.mark.parametrize("env", ENVS, ids=lambda env: type(env).__name__)


@by_class
@pytest.mark.parametrize("action_masks", ["observation", "info"])
def test_api(env, action_masks):
    parallel_api_test(envs_jax.to_pettingzoo(env, action_masks=action_masks), num_cycles=30)


@by_class
def test_same_seed_same_episodes(env):
    parallel_seed_test(lambda: envs_jax.to_pettingzoo(env), num_cycles=15)


@pytest.mark.filterwarnings("ignore:Environment's m:UserWarning")  # Bounds are unknown.
def test_state_space_holds_the_state():
    env = envs_jax.to_pettingzoo(AliceAndBob(max_steps=12))
    env.reset()
    assert env.state_space.contains(env.state())
    state_test(parallel_to_aec(env), env, num_cycles=5)


def test_numbers_equal_those_of_the_environment():
    env = AliceAndBob(max_steps=6)
    theirs = envs_jax.to_pettingzoo(env, seed=3)
    obs, infos = theirs.reset()
    key, key_reset = jax.random.split(jax.random.key(3))
    env_state, timestep = env.reset(key_reset)
    actions = np.random.default_rng(0).integers(env.num_actions, size=(6, 2))
    for time, action in enumerate(actions, start=1):
        for index, agent in enumerate(theirs.agents):
            np.testing.assert_array_equal(obs[agent]["observation"], timestep.obs[index])
            np.testing.assert_array_equal(obs[agent]["action_mask"], [1] * 5)
            assert theirs.observation_space(agent).contains(obs[agent])
            assert infos[agent]["diamonds"] == timestep.info["diamonds"]
        np.testing.assert_array_equal(theirs.state(), timestep.state)
        np.testing.assert_array_equal(theirs.render(), env.render(env_state))
        key, key_step = jax.random.split(key)
        env_state, timestep = env.step(key_step, env_state, action)
        given = dict(zip(theirs.agents, action))
        obs, rewards, terminations, truncations, infos = theirs.step(given)
        assert rewards == dict.fromkeys(given, 0.0)
        assert terminations == dict.fromkeys(given, False)
        assert truncations == dict.fromkeys(given, time == 6)
    assert theirs.agents == []


def test_masks_and_rewards():
    env = envs_jax.to_pettingzoo(LegalAction(), action_masks="info")
    seen = set()
    for seed in range(8):
        obs, infos = env.reset(seed=seed)
        assert obs["agent_0"].shape == (8,)
        masks = [infos[agent]["action_mask"] for agent in env.agents]
        seen.add(tuple(mask.argmax() for mask in masks))
        legal = {agent: mask.argmax() for agent, mask in zip(env.agents, masks)}
        _, rewards, terminations, truncations, infos = env.step(legal)
        assert rewards == {"agent_0": 1.0, "agent_1": 1.0}
        assert terminations == {"agent_0": True, "agent_1": True}
        assert truncations == {"agent_0": False, "agent_1": False}
        assert infos["agent_1"]["success"] == 1
    assert len(seen) > 1


def test_episodes_differ_unless_seeded_again():
    env = envs_jax.to_pettingzoo(AliceAndBob(), seed=1)
    first, second = (env.reset()[0]["agent_0"]["observation"] for _ in range(2))
    again = env.reset(seed=1)[0]["agent_0"]["observation"]
    assert (first != second).any()
    np.testing.assert_array_equal(first, again)


def test_mistakes_are_reported():
    env = envs_jax.to_pettingzoo(LegalAction())
    for early in (env.state, env.render, lambda: env.step({})):
        with pytest.raises(ValueError, match="call reset first"):
            early()
    env.reset()
    with pytest.raises(ValueError, match="actions has no entry for agent_1; give"):
        env.step({"agent_0": 0})
    env.step({"agent_0": 0, "agent_1": 0})
    with pytest.raises(ValueError, match="no episode is running: call reset first"):
        env.step({"agent_0": 0, "agent_1": 0})
    with pytest.raises(ValueError, match="seed must be at least 0, got -1"):
        env.reset(seed=-1)
    with pytest.raises(ValueError, match="action_masks must be observation or info, got 'obs'"):
        envs_jax.to_pettingzoo(LegalAction(), action_masks="obs")
