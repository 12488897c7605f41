"""The average of recent parameters, by hand, and in the policies that evaluation uses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose

import envs_jax
from hmasd_jax.baselines.eiti.algorithm import make_eiti
from hmasd_jax.baselines.eiti.config import EITIConfig
from hmasd_jax.baselines.mappo import MAPPOConfig, make_mappo
from hmasd_jax.baselines.mat import MATConfig, make_mat
from hmasd_jax.hmasd.algorithm import make_hmasd
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.rl.averaging import averaged_params, track_average
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.rl.sgd import gradient_step, make_optimizer
from hmasd_jax.types import Learner
from tests.helpers.algorithms import draw_state

ENV = envs_jax.make("probe_match_cue")
PPO = PPOConfig(
    num_envs=2, rollout_length=10, hidden_size=8, sequence_length=5, num_epochs=1,
    average_updates=4,
)  # fmt: skip


def test_recent_parameters_weigh_most():
    """Parameters 1, 2, 3 with a decay of one half: (0.125 + 0.5 + 1.5) / 0.875."""
    transform = track_average(0.5)
    params = jnp.zeros(1)
    state = transform.init(params)
    assert_allclose(state.average, [0.0])
    for _ in range(3):
        updates, state = transform.update(jnp.ones(1), state, params)
        params = optax.apply_updates(params, updates)
    assert_allclose(params, [3.0])
    assert_allclose(state.average, [2.125 / 0.875], rtol=1e-6)


def test_each_network_has_its_average_and_training_does_not_see_it():
    def loss(params):
        return (params["actor"]["w"] ** 2).sum() + (params["critic"]["b"] * 3.0).sum(), {}

    start = {"actor": {"w": jnp.ones((2, 3))}, "critic": {"b": jnp.ones(2)}}
    ends = []
    for config in (PPO, dataclasses.replace(PPO, average_updates=0)):
        optimizer = make_optimizer(config, list(start))
        learner = Learner(start, optimizer.init(start))
        steps = [learner.params]
        for _ in range(2):
            learner, _ = gradient_step(learner, optimizer, loss)
            steps.append(learner.params)
        ends.append((learner, steps[1:]))
    (with_average, (one, two)), (without, _) = ends
    jax.tree.map(np.testing.assert_array_equal, with_average.params, without.params)
    jax.tree.map(np.testing.assert_array_equal, averaged_params(without), without.params)
    # A decay of 1 - 1/4: one gradient step per update.
    expected = jax.tree.map(lambda a, b: (0.75 * a + b) / 1.75, one, two)
    jax.tree.map(
        lambda a, b: assert_allclose(a, b, rtol=1e-5), averaged_params(with_average), expected
    )


ALGORITHMS = {
    "mappo": (make_mappo, MAPPOConfig(ppo=PPO), ["learner"]),
    "eiti": (make_eiti, EITIConfig(ppo=PPO), ["learner"]),
    "mat": (make_mat, MATConfig(ppo=PPO), ["learner"]),
    "hmasd": (
        make_hmasd, HMASDConfig(skill_interval=5, ppo=PPO, discriminator_epochs=1),
        ["coordinator", "discoverer"],
    ),
}  # fmt: skip


def acting(algorithm):
    """Build a function of the state: actions that 64 copies of the start of an episode draw."""

    def act(state):
        policy = algorithm.policy(state, greedy=False)
        keys = jax.random.split(jax.random.key(1), 64)
        _, timestep = jax.vmap(ENV.reset)(keys)
        first = jnp.ones(64, bool)
        return policy.step(policy.init((64,)), timestep, first, jax.random.key(2))[1]

    return jax.jit(act)


@pytest.mark.parametrize("updates", [0, 4])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_policy_acts_by_the_average_where_there_is_one(name, updates):
    """Parameters are replaced, and the average is left as it is."""
    make, config, learners = ALGORITHMS[name]
    ppo = dataclasses.replace(PPO, average_updates=updates)
    algorithm = make(ENV, dataclasses.replace(config, ppo=ppo))
    state = draw_state(algorithm, 0)

    def replace(learner):
        return learner._replace(
            params=jax.tree.map(
                lambda x: 20 * jnp.sin(x + jnp.arange(x.size).reshape(x.shape)), learner.params
            )
        )

    changed = state._replace(**{field: replace(getattr(state, field)) for field in learners})
    actions_of = acting(algorithm)
    is_same = (actions_of(state) == actions_of(changed)).all()
    assert is_same == (updates > 0)
