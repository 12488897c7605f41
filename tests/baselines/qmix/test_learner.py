"""Targets by hand, mixers, the target networks, and exploration."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.baselines.qmix import algorithm
from hmasd_jax.baselines.qmix.config import QLearningConfig
from hmasd_jax.baselines.qmix.learner import Values, evaluate_episodes, td_loss
from hmasd_jax.baselines.qmix.networks import AgentNet, Networks, QMIXMixer, VDNMixer
from hmasd_jax.baselines.qmix.replay import Episodes, Seen

T, B, N = 3, 2, 2


def test_td_loss_by_hand():
    episodes = SimpleNamespace(
        terminated=jnp.array([[0, 0], [1, 0], [0, 0]], bool),  # The second is cut after 3 steps.
        valid=jnp.array([[1, 1], [1, 1], [0, 1]], bool),
    )
    values = Values(
        online=None, taken=None, target=None, greedy=None,
        total=jnp.array([[1.0, 2.0], [3.0, 4.0], [100.0, 5.0]]),
        greedy_total=jnp.array([[9.0, 9.0], [2.0, 4.0], [50.0, 6.0], [50.0, 8.0]]),
    )  # fmt: skip
    reward = jnp.array([[1.0, 0.0], [2.0, 1.0], [70.0, 0.0]])
    loss, metrics = td_loss(values, reward, episodes, discount=0.5)
    # Targets 1 + 2/2, 0 + 4/2; 2, 1 + 6/2; -, 0 + 8/2. Errors -1, 0; 1, 0; -, 1.
    assert_allclose(loss, 3 / 5)
    assert_allclose(metrics["td_error_abs"], 3 / 5)
    assert_allclose(metrics["target"], (2 + 2 + 2 + 4 + 4) / 5)


def random_episodes(key):
    keys = jax.random.split(key, 4)
    legal = jax.random.bernoulli(keys[0], 0.5, (T + 1, B, N, 4)).at[..., 0].set(True)
    seen = Seen(
        obs=jax.random.normal(keys[1], (T + 1, B, N, 5)),
        state=jax.random.normal(keys[2], (T + 1, B, 6)),
        action_mask=legal,
    )
    action = jax.random.randint(keys[3], (T, B, N), 0, 4)
    no = jnp.zeros((T, B), bool)
    return Episodes(seen, action, jnp.zeros((T, B)), no, ~no)


def test_double_q_learning_takes_the_target_of_the_legal_action_that_is_best_online():
    networks = Networks(AgentNet(4, 8), VDNMixer())
    episodes = random_episodes(jax.random.key(0))
    first = SimpleNamespace(**{k: v[0] for k, v in episodes.seen._asdict().items()})
    params, target = (networks.init(jax.random.key(i), first) for i in (1, 2))
    values = jax.jit(lambda *x: evaluate_episodes(networks, *x))(params, target, episodes)
    online = np.where(episodes.seen.action_mask, values.online, -np.inf)
    best = online.argmax(-1)
    assert (best != np.asarray(values.online).argmax(-1)).any()  # the mask matters
    expected = np.take_along_axis(np.asarray(values.target), best[..., None], -1)[..., 0]
    assert_allclose(values.greedy, expected)
    assert_allclose(values.greedy_total, expected.sum(-1), rtol=1e-6)


def test_acting_step_by_step_gives_the_values_of_the_replayed_episode():
    networks = Networks(AgentNet(4, 8), VDNMixer())
    episodes = random_episodes(jax.random.key(0))
    steps = [
        SimpleNamespace(**{k: v[t] for k, v in episodes.seen._asdict().items()}) for t in range(T)
    ]
    params = networks.init(jax.random.key(1), steps[0])
    replayed = evaluate_episodes(networks, params, params, episodes).online
    # Memory of an earlier episode must not matter.
    memory = jax.tree.map(jnp.ones_like, networks.init_memory((B, N)))
    for t, timestep in enumerate(steps):
        hidden, values = networks.act(params, memory, timestep, jnp.full(B, t == 0))
        assert_allclose(values, replayed[t], atol=1e-6)
        memory = memory._replace(hidden=hidden, last_action=episodes.action[t])


def test_the_total_value_of_qmix_grows_with_every_agents_value_and_depends_on_the_state():
    mixer = QMIXMixer(6)
    values = jax.random.normal(jax.random.key(0), (50, 3))
    states = jax.random.normal(jax.random.key(1), (50, 4))
    params = mixer.init(jax.random.key(2), values, states)
    slopes = jax.vmap(jax.grad(lambda v, s: mixer.apply(params, v, s)))(values, states)
    assert (slopes >= 0).all()
    assert slopes.std() > 0.01
    assert (mixer.apply(params, values, states) != mixer.apply(params, values, -states)).all()


@pytest.mark.parametrize(("updates", "expected"), [(0, 1.0), (5, 0.6), (10, 0.2), (99, 0.2)])
def test_exploration_falls_linearly_with_environment_steps(updates, expected):
    config = QLearningConfig(
        num_envs=2, rollout_length=5, epsilon_steps=100, epsilon_start=1.0, epsilon_end=0.2
    )
    assert_allclose(algorithm.epsilon(config, jnp.int32(updates)), expected, rtol=1e-6)


def test_random_actions_are_legal_and_as_frequent_as_epsilon_says():
    values = jnp.broadcast_to(jnp.array([0.0, 3.0, 5.0, 4.0]), (20_000, 4))
    legal = jnp.broadcast_to(jnp.array([True, True, False, True]), values.shape)
    action = algorithm.epsilon_greedy(values, legal, jnp.float32(0.3), jax.random.key(0))
    share = np.bincount(np.asarray(action), minlength=4) / len(action)
    assert_allclose(share, [0.1, 0.1, 0.0, 0.8], atol=0.01)
    greedy = algorithm.epsilon_greedy(values, legal, jnp.float32(0), jax.random.key(0))
    assert (greedy == 3).all()
