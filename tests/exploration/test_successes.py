"""The store of successes and its imitation, by hand."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import envs_jax
from hmasd_jax.baselines.mappo import MAPPOConfig
from hmasd_jax.baselines.mappo import algorithm as mappo
from hmasd_jax.exploration.successes import (
    NO_IMITATION,
    ImitationConfig,
    imitation_loss,
    insert,
)
from hmasd_jax.hmasd.components import make_parts
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.networks.actor_critic import ActorCriticMemory, SequenceBatch
from hmasd_jax.rl.gae import reward_to_go
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.types import Learner

ENV = envs_jax.make("alice_and_bob")
PPO = PPOConfig(num_envs=2, rollout_length=4, sequence_length=2, hidden_size=8)
PARTS = mappo.make_parts(
    ENV, MAPPOConfig(imitation=ImitationConfig(coef=1.0, capacity=3, inserts=2, steps=5), ppo=PPO)
)


@pytest.fixture(scope="module")
def learner():
    return jax.jit(lambda key: mappo.init_state(PARTS, key).learner)(jax.random.key(0))


def _batch(num_sequences, action=0):
    agents = (num_sequences, 2, ENV.num_agents)
    return SequenceBatch(
        memory=ActorCriticMemory(
            jnp.zeros((num_sequences, ENV.num_agents, 8)), jnp.zeros((num_sequences, 1, 8))
        ),
        first=jnp.zeros((num_sequences, 2), bool),
        obs=jnp.ones((*agents, ENV.obs_dim)),
        state=jnp.zeros((num_sequences, 2, 1, ENV.state_dim)),
        action_mask=jnp.ones((*agents, ENV.num_actions), bool),
        action=jnp.full(agents, action),
        log_prob=jnp.zeros(agents),
        value=jnp.zeros((num_sequences, 2, 1)),
        advantage=jnp.zeros(agents),
        target=jnp.zeros((num_sequences, 2, 1)),
    )


def test_rewards_flow_back_to_the_start_of_their_episode_only():
    reward = jnp.array([[0.0], [4.0], [0.0], [8.0]])
    done = jnp.array([[False], [True], [False], [False]])
    assert_allclose(reward_to_go(reward, done, 0.5)[:, 0], [2, 4, 4, 8])


def test_only_sequences_with_reward_are_stored_the_oldest_are_replaced():
    store = PARTS.imitation.init()
    key = jax.random.key(0)
    store, metrics = insert(store, _batch(2, 1), jnp.array([[0.0, 0.0], [2.0, 4.0]]), 2, key)
    assert metrics["stored_successes"] == 1
    assert_allclose(store.weight, [[0.5, 1.0], [0, 0], [0, 0]])
    np.testing.assert_array_equal(store.steps.action[0], 1)
    # At most two of three per rollout; the third slot is filled, then the first is replaced.
    three = jnp.ones((3, 2))
    store, metrics = insert(store, _batch(3, 2), three, 2, key)
    assert metrics["stored_successes"] == 2
    store, _ = insert(store, _batch(1, 3), three[:1], 2, key)
    np.testing.assert_array_equal(store.steps.action[:, 0, 0], [3, 2, 2])
    assert store.next_slot == 1


def test_sequences_are_drawn_in_proportion_to_their_reward():
    """The first of three is followed by half the reward: a draw of one takes it in a fifth."""
    weight = jnp.array([[0.5, 0.25], [1.0, 1.0], [1.0, 1.0], [0.0, 0.0]])
    batch = _batch(4)._replace(action=jnp.arange(4)[:, None, None] + jnp.zeros((4, 2, 2), int))

    def draw(key):
        return insert(PARTS.imitation.init(), batch, weight, 1, key)[0].steps.action[0, 0, 0]

    drawn = jax.vmap(draw)(jax.random.split(jax.random.key(0), 4000))
    share = np.bincount(drawn, minlength=4) / 4000
    assert_allclose(share, [0.2, 0.4, 0.4, 0.0], atol=0.03)


def test_a_rollout_without_reward_stores_nothing():
    store = PARTS.imitation.init()
    after, _ = insert(store, _batch(2), jnp.zeros((2, 2)), 2, jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, after, store)


def test_the_loss_weighs_log_probabilities_and_averages_over_empty_slots_too(learner):
    batch = _batch(1, action=2)
    store, _ = insert(PARTS.imitation.init(), batch, jnp.array([[2.0, 4.0]]), 2, jax.random.key(0))
    loss = imitation_loss(learner.params, PARTS.networks, store)
    _, distribution = PARTS.networks.act(
        learner.params, batch.memory.actor, batch.obs.swapaxes(0, 1),
        batch.action_mask.swapaxes(0, 1), batch.first.swapaxes(0, 1),
    )  # fmt: skip
    log_prob = np.asarray(distribution.log_prob(jnp.full((2, 1, ENV.num_agents), 2)))
    # Weights 0.5 and 1; the mean is over 3 slots x 2 steps x N agents.
    expected = -(0.5 * log_prob[0].sum() + log_prob[1].sum()) / (6 * ENV.num_agents)
    assert_allclose(loss, expected, rtol=1e-5)


def test_training_raises_the_probability_of_stored_actions_and_an_empty_store_changes_nothing(
    learner,
):
    empty = PARTS.imitation.init()
    train = jax.jit(partial(PARTS.imitation.train, optimizer=PARTS.optimizer))
    same, _ = train(empty, learner)
    jax.tree.map(np.testing.assert_array_equal, same, learner)
    store, _ = insert(empty, _batch(2, 3), jnp.ones((2, 2)), 2, jax.random.key(0))
    trained, _ = train(store, learner)
    before, after = (imitation_loss(x.params, PARTS.networks, store) for x in (learner, trained))
    assert after < before - 1e-3
    jax.tree.map(np.testing.assert_array_equal, trained.params["critic"], learner.params["critic"])


@pytest.mark.parametrize(("coef", "steps"), [(1.0, 3 * (2 + 5)), (0.0, 3 * 2)])
@pytest.mark.parametrize("algorithm", ["mappo", "hmasd"])
def test_the_step_size_counts_the_steps_of_imitation(algorithm, coef, steps):
    settings = {
        "imitation": ImitationConfig(coef=coef, steps=5),
        "ppo": replace(PPO, num_epochs=2, decay_updates=3),
    }
    if algorithm == "mappo":
        optimizer = mappo.make_parts(ENV, MAPPOConfig(**settings)).optimizer
    else:
        config = HMASDConfig(skill_interval=2, **settings)
        optimizer = make_parts(ENV, config).discoverer_optimizer
    params = {"actor": jnp.ones(1), "critic": jnp.ones(1)}

    def step(state, _):
        updates, state = optimizer.update(params, state, params)
        return state, updates["actor"][0]

    moves = jax.lax.scan(step, optimizer.init(params), None, length=steps + 1)[1]
    assert (moves[:steps] < 0).all()
    assert moves[steps] == 0


def test_a_rollout_stores_at_most_what_the_buffer_holds():
    with pytest.raises(ValueError, match="inserts must be between 1 and 3, got 4"):
        ImitationConfig(capacity=3, inserts=4)


def test_without_a_weight_nothing_is_stored():
    parts = mappo.make_parts(ENV, MAPPOConfig(ppo=PPO))
    assert parts.imitation is NO_IMITATION
    assert parts.imitation.train((), Learner(1, 2), parts.optimizer) == (Learner(1, 2), {})


@pytest.mark.parametrize("config", [MAPPOConfig, HMASDConfig])
@pytest.mark.parametrize(("copies", "message"), [(32, "less than ppo.num_envs = 32"), (-1, "-1")])
def test_some_copies_must_be_left_to_explore(config, copies, message):
    with pytest.raises(ValueError, match=message):
        config(imitation=ImitationConfig(greedy_copies=copies))
