"""Copies that act greedily, by hand and in MAPPO."""

from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import envs_jax
from hmasd_jax.baselines.mappo import MAPPOConfig
from hmasd_jax.baselines.mappo import algorithm as mappo
from hmasd_jax.exploration.bonus import NO_BONUS
from hmasd_jax.exploration.frontier import FrontierConfig
from hmasd_jax.exploration.greedy_copies import actions_entropy_coef, blame_greedy
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


def counting(shares):
    """Return a bonus that knows the share of unsolved episodes of each copy."""
    return NO_BONUS._replace(
        entropy_weight=lambda _: 0.5,
        unsolved=lambda _, copies=True: jnp.array(shares).mean(where=copies),
    )


@pytest.mark.parametrize(
    ("unsolved", "coef"),
    [
        ([0.0, 0.0, 0.0, 0.0], 0.15),  # sampling loses nothing
        ([0.0, 0.0, 1.0, 1.0], 0.15 - 3.2 * 1.0 / 16),  # all that greedy copies win, of a half
        ([0.25, 0.25, 0.75, 0.75], 0.15 - 3.2 * 0.5 / 16),
        ([1.0, 1.0, 0.0, 0.0], 0.15),  # sampling wins more
    ],
)
def test_actions_become_sure_as_far_as_sampling_loses_what_is_solved(unsolved, coef):
    """Half of 0.3, and less by the share that sampling loses times the chance that all win."""
    ppo = PPOConfig(num_envs=4, rollout_length=10)
    config = MAPPOConfig(
        ppo=ppo, imitation=ImitationConfig(greedy_copies=2), frontier=FrontierConfig(coef=1.0),
        sharpening=3.2,
    )  # fmt: skip
    assert_allclose(actions_entropy_coef(counting(unsolved), (), config, 0.3), coef, rtol=1e-6)
    plain = replace(config, sharpening=0.0)
    assert type(actions_entropy_coef(counting(unsolved), (), plain, 0.3)) is float


def test_sharpening_needs_copies_that_act_greedily():
    with pytest.raises(ValueError, match=r"sharpening 2.0 needs imitation.greedy_copies above 0"):
        MAPPOConfig(sharpening=2.0, frontier=FrontierConfig(coef=1.0))


@pytest.mark.parametrize(("sharpening", "entropy_coef"), [(0.0, 0.25), (4.0, 0.125)])
def test_mappo_trains_with_the_coefficient_that_sharpening_leaves(sharpening, entropy_coef):
    """Two copies act greedily and win, and the others lose a quarter of their episodes."""
    ppo = PPOConfig(num_envs=4, rollout_length=10, num_epochs=2, hidden_size=8)
    imitation = ImitationConfig(greedy_copies=2)
    config = MAPPOConfig(entropy_coef=0.5, ppo=ppo, imitation=imitation)
    parts = mappo.make_parts(envs_jax.make("probe_match_cue"), config)
    state = jax.jit(lambda key: mappo.init_state(parts, key))(jax.random.key(0))

    def update(parts):
        return jax.jit(lambda state: mappo.train_iteration(parts, state)[0])(state).learner.params

    bonus = parts.bonus._replace(
        entropy_weight=lambda _: 0.5,
        unsolved=lambda _, copies=True: jnp.array([0.0, 0.0, 0.25, 0.25]).mean(where=copies),
    )
    # The chance that all four win is (1 - 1/8)^4.
    sharper = sharpening / (1 - 1 / 8) ** 4 / 8
    sure = replace(config, frontier=FrontierConfig(coef=1.0), sharpening=sharper)
    fixed = replace(parts, config=replace(config, entropy_coef=entropy_coef))
    chex.assert_trees_all_close(
        update(replace(parts, config=sure, bonus=bonus)), update(fixed), rtol=1e-5, atol=1e-6
    )


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
