"""HMASD computes what the authors' PyTorch code computes (see golden/README.md)."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from envs_jax import TimeStep
from hmasd_jax.hmasd import algorithm, batches
from hmasd_jax.hmasd.components import make_parts
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.coordinator import Assignment, assign
from hmasd_jax.hmasd.discriminators import log_q_of_skills
from hmasd_jax.hmasd.rewards import low_level_reward
from hmasd_jax.hmasd.rollout_phase import Extras, Rollout, RolloutMemory
from hmasd_jax.networks.actor_critic import ActorCriticMemory
from hmasd_jax.networks.recurrent import apply
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.rl.rollout import flatten
from hmasd_jax.rl.value_norm import ValueNorm
from hmasd_jax.types import EnvCarry, Learner, Transition
from tests.helpers.golden import actor_or_critic, block, head, linear, load, norm

T, E, N, K, OBS, STATE, ACTIONS = 6, 4, 3, 2, 5, 7, 4
ENV = SimpleNamespace(num_agents=N, num_actions=ACTIONS, obs_dim=OBS, state_dim=STATE)
PPO = PPOConfig(
    num_envs=E, rollout_length=T, sequence_length=3, hidden_size=8, num_epochs=2,
    learning_rate=0.01, max_grad_norm=0.3, value_coef=0.7, clip_epsilon=0.2, huber_delta=0.5,
    discount=0.9, gae_lambda=0.8,
)  # fmt: skip
CONFIG = HMASDConfig(
    skill_interval=K, num_heads=2, high_entropy_coef=0.05, low_entropy_coef=0.02,
    extrinsic_coef=5.0, team_intrinsic_coef=0.3, individual_intrinsic_coef=0.7,
    discriminator_epochs=3, ppo=PPO,
)  # fmt: skip
VARIANTS = {
    "last_layer": {"skill_at": "last_layer", "num_team_skills": 2, "num_skills": 3},
    "input": {"skill_at": "input", "num_team_skills": 3, "num_skills": 2},
}


def coordinator_params(table):
    encoder, decoder = "coordinator.encoder", "coordinator.decoder"
    params = {
        "encoder_norm": norm(table, f"{encoder}.ln"),
        "value_head": head(table, f"{encoder}.head"),
        "embed_team_skill": linear(table, f"{decoder}.team_action_encoder.0"),
        "embed_skill": linear(table, f"{decoder}.indi_action_encoder.0"),
        "decoder_norm": norm(table, f"{decoder}.ln"),
        "skill_head": head(table, f"{decoder}.head"),
    }
    for name in ("state", "obs"):
        params[f"embed_{name}"] = {
            "layers_0": norm(table, f"{encoder}.{name}_encoder.0"),
            "layers_1": linear(table, f"{encoder}.{name}_encoder.1"),
        }
    for i in range(CONFIG.num_blocks):
        params[f"encoder_blocks_{i}"] = block(table, f"{encoder}.blocks.{i}", ["attn"])
        attentions = ["attn1", "attn2"]
        params[f"decoder_blocks_{i}"] = block(table, f"{decoder}.blocks.{i}", attentions)
    return {"params": params}


def all_params(table):
    """Parameters of coordinator, discoverer and discriminators."""
    discoverer = {
        "actor": actor_or_critic(table, "actor", "act.action_out.linear"),
        "critic": actor_or_critic(table, "critic", "v_out"),
    }
    names = ("team", "individual")
    discriminators = {name: actor_or_critic(table, name, "output.linear") for name in names}
    return coordinator_params(table), discoverer, discriminators


def rollout_of(data):
    """Return the recorded rollout as one of ours. Old results are those that they learn from."""
    zeros, no = np.zeros((T + 1, E), np.float32), np.zeros((T + 1, E), bool)
    seen = TimeStep(data["obs"], data["state"], data["legal"], zeros, no, no, {})
    timestep, last = (jax.tree.map(lambda x, i=i: x[i], seen) for i in (slice(T), T))
    outcome = timestep._replace(reward=data["reward"], terminated=data["first"][1:])
    memory = ActorCriticMemory(data["memory"], data["critic_memory"])
    in_use = Assignment(data["skills"], data["old_high_log_prob"], data["old_high_value"])
    in_use = jax.tree.map(lambda x: x.repeat(K, axis=0), in_use)  # of every step
    renewed = jnp.broadcast_to((jnp.arange(T) % K == 0)[:, None], (T, E))
    extras = Extras(
        low=jax.tree.map(lambda x: x[:T], memory), log_prob=data["old_low_log_prob"],
        value=data["old_low_value"][..., 0], assignment=in_use, renewed=renewed,
        sampled=renewed,
    )  # fmt: skip
    following = Assignment(
        data["next_skills"], np.zeros((E, 1 + N), np.float32), data["next_high_value"]
    )
    return Rollout(
        transitions=Transition(timestep, data["first"][:-1], data["action"], extras, outcome),
        env=EnvCarry(None, last, data["first"][-1]),
        memory=RolloutMemory(jax.tree.map(lambda x: x[T], memory), following, np.zeros(E, int)),
        next_assignment=following,
    )


def compute(parts, params, norms, data):
    """Return what is computed of the recorded rollout, as in `algorithm.train_iteration`."""
    rollout = rollout_of(data)
    steps, key = rollout.transitions, jax.random.key(0)
    coordinator, discoverer, discriminators = params
    logits, value = apply(
        parts.coordinator, coordinator, steps.timestep.state[::K], steps.timestep.obs[::K],
        data["skills"],
    )  # fmt: skip
    log_prob = jnp.take_along_axis(jax.nn.log_softmax(logits), data["skills"][..., None], -1)
    assigned = assign(
        parts.coordinator, coordinator, data["state"][::K], data["obs"][::K], key, greedy=True
    )
    high = log_prob[..., 0], value, assigned.skills

    begin = jax.tree.map(lambda x: x[0], steps.extras.low)
    skills = steps.extras.assignment.skills
    actor, distribution = parts.discoverer.act(
        discoverer, begin.actor, steps.timestep.obs, steps.timestep.action_mask, steps.first,
        skills[..., 1:],
    )  # fmt: skip
    critic, value = parts.discoverer.value(
        discoverer, begin.critic, steps.timestep.state, steps.first, skills[..., 0]
    )
    low = distribution.log_prob(steps.action), value, actor, critic

    pairs = flatten(batches.skill_pairs(parts, rollout))
    log_q = log_q_of_skills(discriminators, parts.discriminators, pairs)[:2]
    reward = low_level_reward(data["reward"].reshape(-1), *log_q, CONFIG).reshape(T, E, N)
    b_high = batches.high_batch(parts, coordinator, norms[0], rollout, key)
    b_low = batches.low_batch(parts, discoverer, norms[1], rollout, reward)

    optimizers = (
        parts.coordinator_optimizer, parts.discoverer_optimizer, parts.discriminator_optimizer
    )  # fmt: skip
    learners = [Learner(p, optimizer.init(p)) for p, optimizer in zip(params, optimizers)]
    state = SimpleNamespace(
        coordinator=learners[0], discoverer=learners[1], discriminators=learners[2],
        coordinator_norm=norms[0], discoverer_norm=norms[1], num_updates=0, bonus=(),
    )  # fmt: skip
    trained = (
        algorithm.train_coordinator(parts, state, b_high, key),
        algorithm.train_discoverer(parts, state, b_low, key),
        algorithm.train_discriminators(parts, state, pairs, key),
    )
    segments = batches.find_segments(parts, coordinator, rollout)
    return high, low, reward, segments.reward[::K], (b_high, b_low), trained


@pytest.fixture(scope="module", params=sorted(VARIANTS))
def run(request):
    data, before, after = load(f"hmasd/{request.param}")
    parts = make_parts(ENV, replace(CONFIG, **VARIANTS[request.param]))
    norms = [ValueNorm(*data[f"{level}_norm"]) for level in ("high", "low")]
    arrays = {name: x for name, x in data.items() if name != "torch"}
    ours = jax.jit(partial(compute, parts))(all_params(before), norms, arrays)
    return data, all_params(after), ours


def assert_equal_in_some_order(ours, theirs):
    """Samples are shuffled, and sequences of all copies are one after the other."""
    assert_allclose(np.sort(ours, axis=None), np.sort(theirs, axis=None), rtol=1e-4, atol=1e-5)


def test_assignments(run):
    data, _, ((log_prob, value, greedy), *_) = run
    assert_allclose(log_prob, data["high_log_prob"], atol=2e-5)
    assert_allclose(value, data["high_value"], atol=2e-5)
    assert_array_equal(greedy, data["greedy_skills"])


def test_acting(run):
    data, _, (_, (log_prob, value, actor, critic), *_) = run
    assert_allclose(log_prob, data["low_log_prob"], atol=2e-5)
    assert_allclose(value, data["low_value"][..., 0], atol=2e-5)
    ended = data["first"][T]  # they clear the memory at once, we do at the next step
    assert_allclose(actor[~ended], data["memory"][T][~ended], atol=2e-5)
    assert_allclose(critic[~ended], data["critic_memory"][T][~ended], atol=2e-5)


def test_rewards(run):
    data, _, (_, _, low, high, *_) = run
    assert_allclose(low, data["low_reward"], rtol=1e-5, atol=1e-5)
    assert_allclose(high, data["high_reward"], rtol=1e-5, atol=1e-6)


def test_returns(run):
    data, _, (*_, (high, low), _) = run
    assert_equal_in_some_order(high.target, data["high_target"])
    assert_equal_in_some_order(low.target, data["low_target"])
    advantage = data["high_advantage"]
    normalized = (advantage - advantage.mean()) / (advantage.std() + 1e-5)
    assert_equal_in_some_order(high.advantage, normalized)


@pytest.mark.parametrize(("level", "index"), [("high", 0), ("low", 1)])
def test_training_of_a_policy(run, level, index):
    data, after, (*_, trained) = run
    learner, value_norm, metrics = trained[index]
    letter = level[0]
    names = {"policy_loss": "policy_loss", "value_loss": "value_loss"}
    names |= {"entropy": "dist_entropy"} if level == "low" else {}
    for ours, theirs in names.items():
        assert_allclose(metrics[ours], data[f"info.{letter}_{theirs}"], rtol=2e-4, atol=1e-6)
    if level == "high":
        entropy = (metrics["team_entropy"] + N * metrics["skill_entropy"]) / (1 + N)
        assert_allclose(entropy, data["info.h_dist_entropy"], rtol=1e-4)
        assert_allclose(metrics["grad_norm"], data["info.h_actor_grad_norm"], rtol=1e-4)
    assert_allclose(value_norm, data[f"{level}_norm_after"], rtol=1e-5)
    # Two steps of Adam move each weight by up to 0.02.
    chex.assert_trees_all_close(learner.params, after[index], atol=3e-5)


def test_training_of_the_discriminators(run):
    data, after, (*_, trained) = run
    learner, metrics = trained[2]
    assert_allclose(metrics["team_loss"], data["info.team_discri_loss"], rtol=1e-4)
    assert_allclose(metrics["individual_loss"], data["info.indi_discri_loss"], rtol=1e-4)
    chex.assert_trees_all_close(learner.params, after[2], atol=3e-5)


@pytest.mark.parametrize("name", sorted(VARIANTS))
def test_the_recorded_rollouts_hold_what_is_hard(name):
    data, _, _ = load(f"hmasd/{name}")
    first, steps = data["first"], np.arange(1, T + 1)
    ends = first[1:]
    assert ends[steps % K != 0].any()  # inside a segment
    assert ends[steps % K == 0][:-1].any()
    assert ends[-1].any()
    assert (data["reward"][ends & (steps % K != 0)[:, None]] > 1).any()  # a success there
    assert ends[steps % 3 != 0].any()  # inside a sequence
    assert (~data["alive"]).any()
    assert (np.diff(data["skills"], axis=0) != 0).any()
    for level in ("high", "low"):
        ratio = np.exp(data[f"{level}_log_prob"] - data[f"old_{level}_log_prob"])
        assert (ratio > 1.2).any()
        assert (ratio < 0.8).any()
