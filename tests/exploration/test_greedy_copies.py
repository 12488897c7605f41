"""Copies that act greedily, by hand and in MAPPO."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

import envs_jax
from hmasd_jax.baselines.mappo import MAPPOConfig
from hmasd_jax.baselines.mappo import algorithm as mappo
from hmasd_jax.exploration.greedy_copies import blame_greedy
from hmasd_jax.exploration.successes import ImitationConfig
from hmasd_jax.rl import rollout
from hmasd_jax.rl.ppo import PPOConfig


def test_the_first_copies_of_mappo_act_greedily_and_the_others_sample():
    env = envs_jax.make("probe_match_cue")
    ppo = PPOConfig(num_envs=8, rollout_length=10, hidden_size=8)

    def act(copies):
        config = MAPPOConfig(ppo=ppo, imitation=ImitationConfig(greedy_copies=copies))
        parts = mappo.make_parts(env, config)

        @jax.jit
        def step(key):
            state = mappo.init_state(parts, key)
            carry = state.env
            act = mappo.act_and_evaluate(parts, state.learner.params)
            _, action, extras = act(state.memory, carry.timestep, carry.first, jax.random.key(1))
            _, distribution = parts.networks.act(
                state.learner.params, state.memory.actor, carry.timestep.obs,
                carry.timestep.action_mask, carry.first,
            )  # fmt: skip
            return action, distribution.mode(), extras.log_prob, distribution.log_prob(action)

        action, mode, log_prob, expected = step(jax.random.key(0))
        assert_allclose(log_prob, expected, atol=1e-6)
        return action, mode

    (action, mode), (sampled, _) = act(6), act(0)
    np.testing.assert_array_equal(action[:6], mode[:6])
    np.testing.assert_array_equal(action[6:], sampled[6:])
    assert (sampled != mode).any()


def test_greedy_copies_are_blamed_for_their_worst_actions_as_far_as_others_succeed():
    advantage = jnp.asarray([[-3.0, -3.0, -3.0], [0.5, 0.5, 0.5]])[..., None]  # (T, E, N)
    greedy = jnp.asarray([True, False, False])
    for reward, weight in [([1, 0, 0], 0.0), ([0, 0, 1], 0.5), ([0, 2, 1], 1.0), ([0, -1, -1], 0)]:
        blamed = blame_greedy(advantage, greedy, jnp.asarray([[0.0, 0.0, 0.0], reward]))
        assert_allclose(blamed[:, 0, 0], [-2 * weight, 0])
        assert_allclose(blamed[:, 1:], advantage[:, 1:])
    assert blame_greedy(advantage, False, jnp.ones((2, 3))) is advantage


def test_mappo_normalizes_by_the_copies_that_sample_and_blames_the_others():
    env = envs_jax.make("probe_match_cue")
    ppo = PPOConfig(num_envs=4, rollout_length=10, sequence_length=5, hidden_size=8)
    parts = mappo.make_parts(env, MAPPOConfig(ppo=ppo))
    state = mappo.init_state(parts, jax.random.key(0))
    carry, memory, transitions = rollout.unroll(
        env, mappo.act_and_evaluate(parts, state.learner.params), state.env, state.memory,
        jax.random.key(1), 10,
    )  # fmt: skip
    reward = jax.random.normal(jax.random.key(2), (10, 4, 1))
    outcome = transitions.outcome._replace(reward=jnp.ones((10, 4)))

    def advantage(copies):
        config = replace(parts.config, imitation=ImitationConfig(greedy_copies=copies))
        batch = mappo.make_batch(
            replace(parts, config=config), state, transitions._replace(outcome=outcome), carry,
            memory.critic, reward,
        )  # fmt: skip
        return batch.advantage.reshape(2, 4, 5, -1)  # sequences, copies, steps, agents

    blamed, sampled = advantage(3), advantage(0)
    others = (sampled - sampled[:, 3].mean()) / sampled[:, 3].std()
    assert_allclose(blamed[:, 3], others[:, 3], atol=1e-3)
    assert_allclose(blamed[:, :3], np.minimum(others[:, :3] + 1, 0), atol=1e-3)
    assert (blamed[:, :3] < 0).any()
