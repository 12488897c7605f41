"""VDN, QMIX and MASER as a whole: purity, when they learn, and tiny tasks that they solve."""

from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import envs_jax
from envs_jax.alice_and_bob import AliceAndBob
from hmasd_jax.algorithms import ALGORITHMS
from hmasd_jax.baselines.qmix.algorithm import make_maser, make_vdn
from hmasd_jax.baselines.qmix.config import MASERConfig, QLearningConfig, QMIXConfig, VDNConfig
from hmasd_jax.rl.evaluate import evaluate
from tests.helpers.algorithms import assert_no_key_is_used_twice

ENV = AliceAndBob(max_steps=7)  # episodes run on from one rollout to the next
TINY = QLearningConfig(
    num_envs=4, rollout_length=5, gradient_steps=2, batch_size=6, buffer_size=10,
    target_interval=3, hidden_size=8, learning_rate=1e-2,
)  # fmt: skip
CONFIGS = {"vdn": VDNConfig, "qmix": QMIXConfig, "maser": MASERConfig}


@pytest.fixture(scope="module")
def run():
    """The paper's MASER, which trains all of its networks, and its states after each update."""
    pure = make_maser(ENV, MASERConfig(variant="paper", distance_coef=1.0, q_learning=TINY))
    update = jax.jit(chex.assert_max_traces(n=1)(lambda state: pure.update(state)))

    states, metrics = [jax.jit(pure.init)(jax.random.key(0))], [{}]
    for _ in range(5):
        state, values = update(states[-1])
        states.append(state)
        metrics.append(values)
    return update, states, metrics


def test_nothing_is_learned_before_a_batch_of_episodes_has_ended(run):
    _, states, metrics = run
    # All copies end an episode at steps 7, 14, 21 and so on, and a batch takes six episodes.
    assert [int(state.replay.ended) for state in states] == [0, 0, 4, 8, 8, 12]
    chex.assert_trees_all_equal(states[2].learner, states[0].learner)
    assert metrics[2]["td_loss"] == metrics[2]["grad_norm"] == 0
    assert metrics[3]["td_loss"] > 0
    moved = jax.tree.map(
        lambda a, b: bool((a != b).any()), states[5].learner.params, states[2].learner.params
    )
    assert all(jax.tree.leaves(moved)), moved


def test_the_target_networks_are_copied_every_third_gradient_step(run):
    _, states, _ = run

    def same(a, b):
        return all(jax.tree.leaves(jax.tree.map(lambda x, y: bool((x == y).all()), a, b)))

    # Update i takes steps 2 i - 1 and 2 i. Copies follow steps 3, 6 and 9.
    assert same(states[3].target_params, states[3].learner.params)
    assert not same(states[4].target_params, states[4].learner.params)
    assert same(states[4].target_params, states[3].target_params)
    assert not same(states[5].target_params, states[4].target_params)
    assert not same(states[5].target_params, states[5].learner.params)


def test_update_is_deterministic_with_finite_metrics(run):
    update, states, metrics = run
    chex.assert_trees_all_equal(update(states[4]), (states[5], metrics[5]))
    chex.assert_tree_all_finite(metrics)
    assert {x.shape for x in metrics[5].values()} == {()}
    names = {"episodes", "episode_sum/success", "team_reward", "td_loss", "epsilon", "grad_norm"}
    names |= {"intrinsic_reward", "individual_loss", "exploration_loss", "distance_loss"}
    assert names <= set(metrics[5])
    assert metrics[5]["episodes"] == 4
    assert states[5].num_updates == 5


def test_seeds_in_one_program_learn_what_they_learn_alone(run):
    update, states, _ = run
    # One of the two has too few episodes and learns nothing yet.
    several = jax.tree.map(lambda *x: jnp.stack(x), states[1], states[4])
    together = jax.jit(jax.vmap(update))(several)[0]
    for i, alone in enumerate((states[2], states[5])):
        one = jax.tree.map(lambda x, i=i: x[i], together)
        chex.assert_trees_all_close(one.learner, alone.learner, atol=1e-5)
        np.testing.assert_array_equal(one.replay.start, alone.replay.start)


@pytest.mark.parametrize("name", CONFIGS)
def test_no_key_is_used_twice(name):
    algorithm = ALGORITHMS[name].make(ENV, CONFIGS[name](q_learning=TINY))
    assert_no_key_is_used_twice(algorithm, TINY.num_envs)


def test_too_small_a_buffer_is_refused():
    with pytest.raises(ValueError, match="buffer_size 8 is smaller than batch_size 32, so that no"):
        QLearningConfig(buffer_size=8)


SMALL = QLearningConfig(
    num_envs=16, rollout_length=10, gradient_steps=4, batch_size=32, buffer_size=500,
    target_interval=20, epsilon_steps=8000, hidden_size=32, learning_rate=2e-3, discount=0.9,
)  # fmt: skip


def test_values_bootstrap_at_time_limits_if_told_to():
    env = envs_jax.make("probe_time_limit")  # two steps with a reward of 1 each
    config = replace(SMALL, discount=0.5, bootstrap_truncation=True)
    algorithm = make_vdn(env, VDNConfig(q_learning=config))

    @jax.jit
    def train(key):
        return jax.lax.scan(
            lambda state, _: algorithm.update(state), algorithm.init(key), length=100
        )[0]

    params = train(jax.random.key(0)).learner.params
    _, timestep = env.reset(jax.random.key(0))
    networks = algorithm.update.args[0].networks
    _, values = networks.act(params, networks.init_memory((2,)), timestep, jnp.bool(True))
    # 1 / (1 - gamma), since there is more to come after the time limit. Without, 1 + gamma = 1.5.
    assert_allclose(values.max(-1).sum(), 2.0, atol=0.2)


@pytest.mark.parametrize(
    ("name", "probe"),
    [
        ("vdn", "probe_match_cue"),
        # The cue is shown at the first step alone, and asked for at the last.
        ("maser", "probe_remember_cue"),
    ],
)
def test_probes_are_solved(name, probe):
    env = envs_jax.make(probe)
    algorithm = ALGORITHMS[name].make(env, CONFIGS[name](q_learning=SMALL))

    @jax.jit
    def train(key):
        state, _ = jax.lax.scan(
            lambda state, _: algorithm.update(state), algorithm.init(key), length=200
        )
        return state, evaluate(env, algorithm.policy(state), jax.random.key(1), 100)

    state, result = train(jax.random.key(0))
    chex.assert_tree_all_finite(state.learner)
    assert result["return"] >= 0.97, result
