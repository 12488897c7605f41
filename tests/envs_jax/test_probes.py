"""Probes have the answers that their docstrings state."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from envs_jax.probes import PROBES

NUM_EPISODES = 2000


def random_action(key, state, timestep):
    return envs_jax.random_actions(key, timestep.action_mask)


def own_index(key, state, timestep):
    return jnp.arange(2)


def shown_cue(key, state, timestep):
    return timestep.obs[:, :2].argmax(1)


def cue_in_state(key, state, timestep):
    return timestep.state[-4:].reshape(2, 2).argmax(1)


def legal(key, state, timestep):
    return timestep.action_mask.argmax(1)


def returns(env, act):
    """Return the mean reward of each step over many episodes, which must end at `max_steps`."""

    @jax.jit
    @jax.vmap
    def episode(key):
        key_reset, key_play = jax.random.split(key)

        def step(carry, key):
            key_action, key_step = jax.random.split(key)
            env_state, timestep = env.step(key_step, carry[0], act(key_action, *carry))
            return (env_state, timestep), (timestep.reward, timestep.done)

        keys = jax.random.split(key_play, env.max_steps)
        return jax.lax.scan(step, env.reset(key_reset), keys)[1]

    reward, done = episode(jax.random.split(jax.random.key(0), NUM_EPISODES))
    np.testing.assert_array_equal(done.any(0), np.arange(env.max_steps) == env.max_steps - 1)
    return np.asarray(reward).mean(0)


# Per probe: mean reward of each step under uniformly random legal actions, a policy that solves
# the probe, and mean rewards under that policy.
ANSWERS = {
    "probe_constant_reward": ([1], random_action, [1]),
    "probe_observed_reward": ([0], random_action, [0]),
    "probe_delayed_reward": ([0, 1], random_action, [0, 1]),
    "probe_time_limit": ([1, 1], random_action, [1, 1]),
    "probe_legal_action": ([1], legal, [1]),
    "probe_own_action": ([0.5], own_index, [1]),
    "probe_match_cue": ([0.5], shown_cue, [1]),
    "probe_remember_cue": ([0, 0, 0, 0, 0.5], cue_in_state, [0, 0, 0, 0, 1]),
    "probe_hidden_cue": ([0.5] * 4, cue_in_state, [1] * 4),
    "probe_different_actions": ([0.5] * 4, own_index, [1] * 4),
}


def test_every_probe_has_an_answer():
    assert ANSWERS.keys() == PROBES.keys()


@pytest.mark.parametrize("name", ANSWERS)
def test_answer(name):
    env = envs_jax.make(name)
    at_random, solution, solved = ANSWERS[name]
    # The largest variance is that of a fair +-1. Its standard error is 1 / sqrt(2000) = 0.022, and
    # the tolerance is four of them.
    np.testing.assert_allclose(returns(env, random_action), at_random, atol=0.09)
    np.testing.assert_allclose(returns(env, solution), solved, atol=0.09)


def test_observed_reward_is_the_cue():
    env = envs_jax.make("probe_observed_reward")
    for seed in range(8):
        env_state, timestep = env.reset(jax.random.key(seed))
        _, outcome = env.step(jax.random.key(0), env_state, jnp.zeros(2, int))
        cues = timestep.obs[:, :2].argmax(1)
        assert cues[0] == cues[1]
        assert outcome.reward == 2 * cues[0] - 1


def test_hidden_facts_stay_hidden():
    def observations(name, action=(0, 0)):
        env = envs_jax.make(name)
        env_state, timestep = env.reset(jax.random.key(0))
        return timestep.obs, env.step(jax.random.key(0), env_state, jnp.array(action))[1].obs

    first, second = observations("probe_remember_cue")
    assert (first[:, :2].sum(1) == 1).all()
    assert not second[:, :2].any()
    assert not any(obs[:, :2].any() for obs in observations("probe_hidden_cue"))
    assert all((obs[0] == obs[1]).all() for obs in observations("probe_different_actions"))


def test_only_the_time_limit_probe_is_truncated():
    for name in PROBES:
        env = envs_jax.make(name)
        env_state, _ = env.reset(jax.random.key(0))
        env_state = env_state._replace(time=jnp.int32(env.max_steps - 1))
        _, last = env.step(jax.random.key(0), env_state, jnp.zeros(2, int))
        is_time_limit = name == "probe_time_limit"
        assert last.truncated == is_time_limit
        assert last.terminated != is_time_limit
