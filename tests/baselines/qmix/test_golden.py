"""VDN, QMIX and MASER compute what the original PyTorch code computes (see golden/README.md)."""

from functools import partial
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.baselines.qmix import maser
from hmasd_jax.baselines.qmix.config import MASERConfig, QLearningConfig
from hmasd_jax.baselines.qmix.learner import evaluate_episodes, factorization_loss, make_optimizer
from hmasd_jax.baselines.qmix.networks import (
    AgentNet,
    DistanceNet,
    MASERNetworks,
    Networks,
    QMIXMixer,
    VDNMixer,
)
from hmasd_jax.baselines.qmix.replay import Episodes, Seen
from hmasd_jax.rl.sgd import gradient_step
from hmasd_jax.types import Learner

GOLDEN = Path(__file__).parents[2] / "golden" / "maser"
LEARNING = QLearningConfig(
    learning_rate=0.01, rms_decay=0.97, rms_epsilon=1e-3, max_grad_norm=2.0, discount=0.9
)
CONFIG = MASERConfig(
    intrinsic_coef=0.3, individual_weight=0.6, individual_coef=0.8, q_learning=LEARNING
)
AGENT, MIXER = AgentNet(num_actions=4, hidden_size=8), QMIXMixer(6)
NETWORKS = {
    "vdn": Networks(AGENT, VDNMixer()),
    "qmix": Networks(AGENT, MIXER),
    "maser": MASERNetworks(AGENT, MIXER, DistanceNet(4)),
}


def linear(table, name):
    return {"kernel": table[f"{name}.weight"].T, "bias": table[f"{name}.bias"]}


def params(table, algorithm):
    """Parameters with our names."""
    agent = {
        "first": linear(table, "agent.fc1"),
        "input": {
            "kernel": table["agent.rnn.weight_ih"].T,
            "bias": table["agent.rnn.bias_ih"],
        },
        "kernel": table["agent.rnn.weight_hh"].T,
        "bias": table["agent.rnn.bias_hh"],
        "head": linear(table, "agent.fc2"),
    }
    ours = {"agent": {"params": agent}, "mixer": {}}
    if algorithm != "vdn":
        names = {
            "weight": "hyper_w_1", "bias": "hyper_b_1", "last_weight": "hyper_w_final",
            "last_bias_hidden": "V.0", "last_bias": "V.2",
        }  # fmt: skip
        mixer = {ours: linear(table, f"mixer.{theirs}") for ours, theirs in names.items()}
        ours["mixer"] = {"params": mixer}
    if algorithm == "maser" and "distance.0.weight" in table:
        distance = {"first": linear(table, "distance.0"), "last": linear(table, "distance.2")}
        ours["distance"] = {"params": distance}
    return ours


def load(algorithm):
    """Results, and weights by when they were recorded."""
    with np.load(GOLDEN / f"{algorithm}.npz") as file:
        table = dict(file)
    parts = {"before": {}, "after": {}, "target": {}}
    for key in [key for key in table if "/" in key]:
        when, parameter = key.split("/")
        parts[when][parameter] = table.pop(key)
    return table, {when: params(weights, algorithm) for when, weights in parts.items()}


def episodes_of(data):
    """Our batch, with time before episodes."""
    by_time = {k: data[k].swapaxes(0, 1) for k in ("obs", "state", "legal", "action", "reward")}
    return Episodes(
        seen=Seen(by_time["obs"], by_time["state"], by_time["legal"]),
        action=by_time["action"][:-1],
        reward=by_time["reward"][:-1],
        terminated=data["terminated"].swapaxes(0, 1)[:-1],
        valid=np.arange(len(by_time["reward"]) - 1)[:, None] < data["length"],
    )


@pytest.fixture(scope="module", params=["vdn", "qmix", "maser"])
def golden(request):
    data, weights = load(request.param)
    return request.param, data, weights, episodes_of(data)


def by_time(x):
    return np.moveaxis(x, 1, 0)


def test_values_and_targets(golden):
    algorithm, data, weights, episodes = golden
    networks = NETWORKS[algorithm]
    values = jax.jit(partial(evaluate_episodes, networks))(
        weights["before"], weights["target"], episodes
    )
    valid = episodes.valid
    assert_allclose(values.online[:-1][valid], by_time(data["values"])[:-1][valid], atol=2e-5)
    assert_allclose(values.total[valid], by_time(data["total"])[valid], rtol=1e-4, atol=1e-5)
    greedy_total = values.greedy_total[:-1][valid]
    assert_allclose(greedy_total, by_time(data["goal_total"])[valid], rtol=1e-4, atol=1e-5)
    reward = by_time(data.get("shaped_reward", data["reward"][:, :-1]))
    target = reward + 0.9 * (1 - episodes.terminated) * values.greedy_total[1:]
    assert_allclose(target[valid], by_time(data["target"])[valid], rtol=1e-4, atol=1e-5)


def test_subgoals_and_intrinsic_reward_of_maser():
    data, weights = load("maser")
    networks, episodes = NETWORKS["maser"], episodes_of(data)
    values = jax.jit(partial(evaluate_episodes, networks))(
        weights["before"], weights["target"], episodes
    )
    goal = maser.subgoals(values.greedy[:-1], values.greedy_total[:-1], episodes.valid, 0.6)
    np.testing.assert_array_equal(goal, data["goal"])
    features = networks.features(weights["before"], episodes.seen.obs[:-1])
    distance = maser.distances(features, goal)
    assert_allclose(-distance, by_time(data["intrinsic"]), rtol=1e-5, atol=1e-5)
    shaped = episodes.reward - 0.3 * distance.mean(-1)
    assert_allclose(shaped, by_time(data["shaped_reward"]), rtol=1e-5, atol=1e-5)
    loss = maser.individual_loss(values, values.greedy[1:], shaped, -0.3 * distance, episodes, 0.9)
    assert_allclose(loss, data["individual_loss"], rtol=1e-4)


def test_two_gradient_steps(golden):
    algorithm, data, weights, episodes = golden
    loss_fn = partial(factorization_loss, NETWORKS[algorithm], 0.9)
    if algorithm == "maser":
        loss_fn = partial(maser.released_loss, NETWORKS[algorithm], CONFIG)
    optimizer = make_optimizer(LEARNING)
    learner = Learner(weights["before"], optimizer.init(weights["before"]))

    @jax.jit
    def train(learner):
        loss, _ = loss_fn(learner.params, weights["target"], episodes)
        for _ in range(2):
            learner, metrics = gradient_step(
                learner, optimizer, loss_fn, weights["target"], episodes
            )
        return loss, learner, metrics

    loss, learner, metrics = train(jax.tree.map(jnp.asarray, learner))
    assert_allclose(loss, data["loss"], rtol=1e-4)
    assert metrics["grad_norm"] > 2.0  # so that the gradient was clipped
    before = jax.tree.leaves((weights["before"]["agent"], weights["before"]["mixer"]))
    after = jax.tree.leaves((weights["after"]["agent"], weights["after"]["mixer"]))
    moved = max(abs(a - b).max() for a, b in zip(after, before))
    assert moved > 0.05
    # A step of RMSprop at its beginning moves a weight by up to 0.06.
    expected = {name: weights["after"][name] for name in learner.params}
    chex.assert_trees_all_close(learner.params, expected, atol=2e-5)
