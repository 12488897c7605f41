"""The sum of two exploration bonuses, and that a bonus is paid."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

import envs_jax
from hmasd_jax.baselines.mappo import MAPPOConfig
from hmasd_jax.baselines.mappo import algorithm as mappo
from hmasd_jax.exploration.bonus import NO_BONUS, Bonus, add
from hmasd_jax.rl.ppo import PPOConfig
from tests.helpers.rollouts import outcome_of

OUTCOME = outcome_of(jnp.arange(12.0).reshape(3, 2, 2))


def constant(value, name):
    """Return a bonus that counts its rollouts and pays `value` times that number."""
    return Bonus(
        init=lambda key: jnp.float32(1),
        update=lambda count, outcome, key: (
            count + 1,
            jnp.full(outcome.reward.shape, value * count),
            {name: count},
        ),
    )


def test_the_sum_pays_both_and_updates_each_on_its_own_state():
    both = add(constant(2.0, "a"), constant(3.0, "b"))
    state = both.init(jax.random.key(0))
    state, reward, metrics = both.update(state, OUTCOME, jax.random.key(1))
    assert metrics == {"a": 1, "b": 1}
    assert_allclose(reward, jnp.full((3, 2), 5.0))
    _, reward, _ = both.update(state, OUTCOME, jax.random.key(2))
    assert_allclose(reward, 10.0)


def test_the_weight_of_the_entropy_is_that_of_the_bonus_that_has_one():
    counting = constant(3.0, "b")._replace(entropy_weight=lambda count: count / 4)
    for both, expected in [(add(constant(2.0, "a"), counting), 0.25), (NO_BONUS, 1.0)]:
        assert both.entropy_weight(both.init(jax.random.key(0))) == expected


def test_the_sum_counts_unsolved_episodes_like_the_bonus_that_does():
    counting = constant(3.0, "b")._replace(unsolved=lambda count, copies: count / 4)
    pairs = [(constant(2.0, "a"), counting), (counting, constant(2.0, "a"))]
    for both, expected in [*((add(*pair), 0.25) for pair in pairs), (NO_BONUS, 1.0)]:
        assert both.unsolved(both.init(jax.random.key(0))) == expected


@pytest.mark.parametrize("other", [constant(2.0, "a"), NO_BONUS])
def test_no_bonus_adds_nothing(other):
    assert add(NO_BONUS, other) is other
    assert add(other, NO_BONUS) is other


def test_mappo_is_paid_the_bonus_beside_the_reward(monkeypatch):
    config = MAPPOConfig(ppo=PPOConfig(num_envs=2, rollout_length=10, hidden_size=8))
    parts = mappo.make_parts(envs_jax.make("probe_constant_reward"), config)
    parts = replace(parts, bonus=constant(3.0, "bonus"))
    noted = {}

    def make_batch(*arguments):
        noted.update(paid=arguments[5], reward=arguments[2].outcome.reward)
        return original(*arguments)

    original = mappo.make_batch
    monkeypatch.setattr(mappo, "make_batch", make_batch)

    @jax.jit
    def update(key):
        mappo.train_iteration(parts, mappo.init_state(parts, key))
        return noted

    used = update(jax.random.key(0))
    assert used["reward"].any()
    assert_allclose(used["paid"][..., 0], used["reward"] + 3.0)
