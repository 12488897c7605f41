"""MAPPO and MAT: exact replay, purity, copies that do not mix, and tiny tasks that they solve."""

from dataclasses import replace
from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from envs_jax.alice_and_bob import AliceAndBob
from hmasd_jax.baselines import mat
from hmasd_jax.baselines.ippo import IPPOConfig, make_ippo
from hmasd_jax.baselines.mappo import MAPPOConfig, make_mappo
from hmasd_jax.baselines.mappo import algorithm as mappo
from hmasd_jax.baselines.mat import MATConfig, make_mat
from hmasd_jax.rl import rollout
from hmasd_jax.rl.evaluate import evaluate
from hmasd_jax.rl.ppo import PPOConfig
from tests.helpers.algorithms import assert_no_key_is_used_twice

ENV = AliceAndBob(max_steps=7)  # episodes end inside sequences of 5 steps
PPO = PPOConfig(
    num_envs=4, rollout_length=20, sequence_length=5, num_epochs=1, hidden_size=8,
    learning_rate=1e-2,
)  # fmt: skip


def _mappo(state, transitions, env, memory, order):
    parts = mappo.make_parts(ENV, MAPPOConfig(ppo=PPO))
    transitions = jax.tree.map(lambda x: x[:, order], transitions)
    env, memory = jax.tree.map(lambda x: x[order], (env, memory))
    reward = transitions.outcome.reward[..., None]
    batch = mappo.make_batch(parts, state, transitions, env, memory.critic, reward)
    return mappo.mappo_loss(parts, state.learner.params, state.norm, batch)


def _mat(state, transitions, env, memory, order):
    parts = mat.make_parts(ENV, MATConfig(ppo=PPO))
    transitions = jax.tree.map(lambda x: x[:, order], transitions)
    batch = mat.make_batch(parts, state, transitions, jax.tree.map(lambda x: x[order], env))
    return mat.mat_loss(parts, state.learner.params, state.norm, batch)


def _acting(name, state):
    if name == "mappo":
        parts = mappo.make_parts(ENV, MAPPOConfig(ppo=PPO))
        return mappo.act_and_evaluate(parts, state.learner.params), state.memory
    parts = mat.make_parts(ENV, MATConfig(ppo=PPO))

    def step(memory, timestep, first, key):
        return memory, *mat.act(parts, state.learner.params, timestep, key, greedy=False)

    return step, ()


@pytest.fixture(scope="module", params=["mappo", "mat"])
def trained(request):
    """An algorithm whose `update` is traced once, a state after three updates, what it does next,
    and the loss on that.
    """
    name = request.param
    pure = make_mappo(ENV, MAPPOConfig(ppo=PPO)) if name == "mappo" else None
    pure = pure or make_mat(ENV, MATConfig(ppo=PPO))
    chex.clear_trace_counter()  # it knows functions by name, and this one comes twice

    @jax.jit
    @chex.assert_max_traces(n=1)
    def update(state):
        return pure.update(state)

    start = state = jax.jit(pure.init)(jax.random.key(0))
    for _ in range(3):
        state, metrics = update(state)

    @jax.jit
    def unroll(state):
        step, memory = _acting(name, state)
        return rollout.unroll(ENV, step, state.env, memory, jax.random.key(1), 20)

    env, memory, transitions = unroll(state)
    loss = jax.jit({"mappo": _mappo, "mat": _mat}[name])
    return SimpleNamespace(
        name=name, update=update, start=start, state=state, metrics=metrics, env=env,
        memory=memory, transitions=transitions, loss=loss,
    )  # fmt: skip


def _loss(trained, order=(0, 1, 2, 3), **changes):
    transitions = trained.transitions._replace(**changes)
    return trained.loss(trained.state, transitions, trained.env, trained.memory, np.array(order))


def test_ratio_is_1_before_learning_across_episode_ends(trained):
    first = np.asarray(trained.transitions.first)
    assert first[np.arange(20) % 5 != 0].any()
    assert _loss(trained)[1]["ratio_error"] < 1e-5
    # The update reports the same, as it takes one step only.
    assert trained.metrics["ratio_error"] < 1e-5


def test_ratio_notices_actions_of_another_step(trained):
    action = jnp.roll(trained.transitions.action, 1, axis=0)
    assert _loss(trained, action=action)[1]["ratio_error"] > 1e-3


def test_ratio_notices_resets_shifted_by_one_step(trained):
    error = _loss(trained, first=jnp.roll(trained.transitions.first, 1, axis=0))[1]["ratio_error"]
    assert (error > 1e-3) == (trained.name == "mappo")  # MAT remembers nothing


def test_the_order_of_copies_does_not_matter(trained):
    loss, metrics = _loss(trained)
    other_loss, other_metrics = _loss(trained, order=(2, 0, 3, 1))
    np.testing.assert_allclose(loss, other_loss, rtol=1e-4, atol=1e-6)
    chex.assert_trees_all_close(metrics, other_metrics, rtol=1e-3, atol=1e-5)


def test_update_is_deterministic_and_moves_all_weights(trained):
    chex.assert_trees_all_equal(trained.update(trained.state), trained.update(trained.state))
    before, after = (x.learner.params for x in (trained.start, trained.state))
    moved = jax.tree.map(lambda a, b: bool((a != b).any()), before, after)
    assert all(jax.tree.leaves(moved)), moved
    assert trained.state.num_updates == 3


def test_metrics_are_finite_scalars_named_as_those_of_hmasd(trained):
    chex.assert_tree_all_finite(trained.metrics)
    assert {x.shape for x in trained.metrics.values()} == {()}
    names = {"episodes", "episode_sum/success", "team_reward", "policy_loss", "entropy"}
    assert names <= set(trained.metrics)
    assert trained.metrics["episodes"] > 0


def test_mat_needs_no_whole_sequences_but_whole_minibatches():
    ppo = PPOConfig(num_envs=2, rollout_length=15, sequence_length=10, num_minibatches=3)
    assert MATConfig(ppo=ppo).ppo == ppo
    with pytest.raises(ValueError, match=r"ppo.num_minibatches 4 does not divide .* = 30"):
        MATConfig(ppo=replace(ppo, num_minibatches=4))
    with pytest.raises(ValueError, match=r"ppo.rollout_length 15 is not a multiple"):
        MAPPOConfig(ppo=ppo)


@pytest.mark.parametrize(
    ("make", "config"), [(make_mappo, MAPPOConfig(ppo=PPO)), (make_mat, MATConfig(ppo=PPO))]
)
def test_no_key_is_used_twice(make, config):
    assert_no_key_is_used_twice(make(ENV, config), PPO.num_envs)


@pytest.mark.parametrize(
    ("config", "seen"),
    [
        (MAPPOConfig(), {"state"}),
        (MAPPOConfig(critic_input="agent"), {"state", "obs"}),
        (IPPOConfig(), {"obs"}),
    ],
    ids=["mappo", "mappo_agent", "ippo"],
)
def test_the_critic_sees_what_its_algorithm_allows(config, seen):
    timestep = ENV.reset(jax.random.key(0))[1]
    before = mappo.critic_input(config, timestep)
    for name in ("state", "obs"):
        changed = timestep._replace(**{name: getattr(timestep, name) + 1})
        differs = (mappo.critic_input(config, changed) != before).any()
        assert differs == (name in seen), name


def test_the_critic_of_ippo_has_a_value_per_agent_of_its_own_observation():
    timestep = ENV.reset(jax.random.key(0))[1]
    np.testing.assert_array_equal(mappo.critic_input(IPPOConfig(), timestep), timestep.obs)
    assert mappo.make_parts(ENV, IPPOConfig(ppo=PPO)).num_values == ENV.num_agents


SMALL = PPOConfig(
    num_envs=32, rollout_length=10, sequence_length=5, hidden_size=16, num_epochs=5,
    learning_rate=5e-3, discount=0.5,
)  # fmt: skip


@pytest.mark.parametrize(
    ("make", "config", "probe", "lowest"),
    [
        # Each agent must remember its own cue.
        (make_mappo, MAPPOConfig(), "probe_remember_cue", 1.0),
        # Without a memory; the critic has a value for each agent.
        (make_mappo, MAPPOConfig(recurrent=False, critic_input="agent"), "probe_match_cue", 1.0),
        (make_ippo, IPPOConfig(), "probe_match_cue", 1.0),
        # Nothing tells the agents apart but the actions of those before them; 4 steps.
        (make_mat, MATConfig(), "probe_different_actions", 4.0),
        # Masks reach the policy; nobody has a choice, so there is nothing to learn from.
        (make_mat, MATConfig(), "probe_legal_action", 1.0),
    ],
    ids=["mappo", "mappo_feed_forward", "ippo", "mat", "mat_without_choices"],
)
def test_probes_are_solved(make, config, probe, lowest):
    env = envs_jax.make(probe)
    algorithm = make(env, replace(config, ppo=SMALL))

    @jax.jit
    def train(key):
        state, _ = jax.lax.scan(
            lambda state, _: algorithm.update(state), algorithm.init(key), length=40
        )
        return state, evaluate(env, algorithm.policy(state), jax.random.key(1), 100)

    state, result = train(jax.random.key(0))
    chex.assert_tree_all_finite(state.learner)
    assert result["return"] >= 0.97 * lowest, result
