"""MAPPO and MAT compute what the original PyTorch code computes (see golden/README.md)."""

from functools import partial
from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from envs_jax import TimeStep
from hmasd_jax.baselines import mat
from hmasd_jax.baselines.mappo import MAPPOConfig
from hmasd_jax.baselines.mappo import algorithm as mappo
from hmasd_jax.baselines.mat import MATConfig
from hmasd_jax.networks.actor_critic import ActorCriticMemory
from hmasd_jax.networks.recurrent import apply
from hmasd_jax.rl import rollout
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.rl.sgd import ppo_epochs
from hmasd_jax.rl.value_norm import ValueNorm, denormalize
from hmasd_jax.types import EnvCarry, Learner, Transition
from tests.helpers.golden import actor_or_critic, block, head, linear, load, norm

T, E, N, ACTIONS = 6, 4, 3, 4
ENV = SimpleNamespace(num_agents=N, num_actions=ACTIONS)
SETTINGS = {
    "num_envs": E, "rollout_length": T, "sequence_length": 3, "hidden_size": 8, "num_epochs": 2,
    "learning_rate": 0.01, "max_grad_norm": 0.3, "value_coef": 0.7, "clip_epsilon": 0.2,
}  # fmt: skip


def mappo_params(table):
    return {
        "actor": actor_or_critic(table, "actor", "act.action_out.linear"),
        "critic": actor_or_critic(table, "critic", "v_out"),
    }


def mat_params(table):
    encoder, decoder = "mat.encoder", "mat.decoder"
    params = {
        "embed_obs": {
            "layers_0": norm(table, f"{encoder}.obs_encoder.0"),
            "layers_1": linear(table, f"{encoder}.obs_encoder.1"),
        },
        "encoder_norm": norm(table, f"{encoder}.ln"),
        "value_head": head(table, f"{encoder}.head"),
        "embed_action": linear(table, f"{decoder}.action_encoder.0"),
        "decoder_norm": norm(table, f"{decoder}.ln"),
        "action_head": head(table, f"{decoder}.head"),
    }
    for i in range(2):
        params[f"encoder_blocks_{i}"] = block(table, f"{encoder}.blocks.{i}", ["attn"])
        attentions = ["attn1", "attn2"]
        params[f"decoder_blocks_{i}"] = block(table, f"{decoder}.blocks.{i}", attentions)
    return {"params": params}


def rollout_of(data, extras):
    """Return the recorded steps as transitions, and the copies after the last of them."""
    no = np.zeros((T + 1, E), bool)
    seen = TimeStep(data["obs"], data["state"], data["legal"], no * 0.0, no, no, {})
    timestep, last = (jax.tree.map(lambda x, i=i: x[i], seen) for i in (slice(T), T))
    outcome = timestep._replace(reward=data["reward"], terminated=data["first"][1:])
    first, action = data["first"], data["action"].astype(int)
    return Transition(timestep, first[:-1], action, extras, outcome), EnvCarry(
        None, last, first[-1]
    )


def assert_same_training(data, batch, learner, value_norm, metrics, after):
    values = batch.target.shape[-1]
    target = data["target"][..., :values]
    assert_allclose(np.sort(batch.target, axis=None), np.sort(target, axis=None), rtol=1e-4)
    assert_allclose(value_norm, data["norm_after"], rtol=1e-5)
    names = {"policy_loss": "policy_loss", "value_loss": "value_loss", "entropy": "dist_entropy"}
    for ours, theirs in names.items():
        assert_allclose(metrics[ours], data[f"info.{theirs}"], rtol=1e-4, atol=1e-6)
    # Two steps of Adam move each weight by up to 0.02.
    chex.assert_trees_all_close(learner.params, after, atol=2e-5)


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("recurrent", {}),
        ("feed_forward", {"recurrent": False, "critic_input": "agent"}),
    ],
)
def test_mappo(name, fields):
    data, before, after = load(f"mappo/{name}")
    config = MAPPOConfig(entropy_coef=0.05, ppo=PPOConfig(**SETTINGS, huber_delta=0.5), **fields)
    parts = mappo.make_parts(ENV, config)
    values = slice(parts.num_values)
    memory = ActorCriticMemory(data["memory"][..., 0, :], data["critic_memory"][:, :, values, 0])
    begin, end = (jax.tree.map(lambda x, i=i: x[i], memory) for i in (0, T))
    before_step = jax.tree.map(lambda x: x[:T], memory)
    extras = mappo.Extras(before_step, data["old_log_prob"], data["old_value"][..., values])
    steps, env = rollout_of(data, extras)
    timestep = steps.timestep

    @jax.jit
    def run(params, value_norm):
        actor, distribution = parts.networks.act(
            params, begin.actor, timestep.obs, timestep.action_mask, steps.first
        )
        seen = mappo.critic_input(config, timestep)
        critic, value = parts.networks.value(params, begin.critic, seen, steps.first)
        learner = Learner(params, parts.optimizer.init(params))
        state = mappo.MAPPOState(None, 0, env, end, learner, value_norm)
        reward = steps.outcome.reward[..., None]
        batch = mappo.make_batch(parts, state, steps, env, end.critic, reward)
        trained = ppo_epochs(
            parts.optimizer, partial(mappo.mappo_loss, parts), learner, value_norm, batch,
            jax.random.key(0), config.ppo,
        )  # fmt: skip
        acted = distribution.log_prob(steps.action), distribution.mode(), value
        return acted, (actor, critic), batch, trained

    acted, memory, batch, trained = run(mappo_params(before), ValueNorm(*data["norm"]))
    assert_allclose(acted[0], data["log_prob"], atol=2e-5)
    assert_allclose(acted[1], data["greedy"])
    assert_allclose(acted[2], data["value"][..., values], atol=2e-5)
    chex.assert_trees_all_close(ActorCriticMemory(*memory), end, atol=2e-5)
    assert_same_training(data, batch, *trained, mappo_params(after))


def test_mat():
    data, before, after = load("mat/mat")
    ppo = PPOConfig(**SETTINGS, huber_delta=50)
    config = MATConfig(entropy_coef=0.05, num_blocks=2, num_heads=2, ppo=ppo)
    parts = mat.make_parts(ENV, config)
    steps, env = rollout_of(data, mat.Extras(data["old_log_prob"], data["old_value"]))
    timestep = steps.timestep

    @jax.jit
    def run(params, value_norm):
        logits, value = apply(
            parts.network, params, timestep.obs, timestep.action_mask, steps.action
        )
        log_prob = jnp.take_along_axis(jax.nn.log_softmax(logits), steps.action[..., None], -1)
        greedy, _ = mat.act(parts, params, timestep, jax.random.key(0), greedy=True)
        learner = Learner(params, parts.optimizer.init(params))
        state = mat.MATState(None, 0, env, learner, value_norm)
        batch = mat.make_batch(parts, state, steps, env)
        trained = ppo_epochs(
            parts.optimizer, partial(mat.mat_loss, parts), learner, value_norm, batch,
            jax.random.key(0), config.ppo,
        )  # fmt: skip
        return (log_prob[..., 0], greedy, value), batch, trained

    acted, batch, trained = run(mat_params(before), ValueNorm(*data["norm"]))
    assert_allclose(acted[0], data["log_prob"], atol=2e-5)
    assert_allclose(acted[1], data["greedy"])
    assert_allclose(acted[2], data["value"], atol=2e-5)
    assert_same_training(data, batch, *trained, mat_params(after))
    assert_allclose(trained[2]["grad_norm"], data["info.actor_grad_norm"], rtol=1e-4)


def test_value_norm():
    data, _, _ = load("mappo/recurrent")
    x = np.linspace(-2, 2, 5, dtype=np.float32)[:, None]
    assert_allclose(denormalize(ValueNorm(*data["norm"]), x), data["denormalized"], rtol=1e-5)


def test_the_recorded_rollouts_hold_what_is_hard():
    for name in ["mappo/recurrent", "mappo/feed_forward", "mat/mat"]:
        data, _, _ = load(name)
        assert data["first"][1:T][np.arange(1, T) % 3 != 0].any()  # inside sequences
        assert (~data["alive"]).any()
        ratio = np.exp(data["log_prob"] - data["old_log_prob"])
        assert (ratio > 1.2).any()
        assert (ratio < 0.8).any()
    assert rollout.cut(data["obs"][:T], 3).shape == (T // 3 * E, 3, N, 5)
