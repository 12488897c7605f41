"""The sum of two exploration bonuses, and what depends on the episodes that a bonus counts."""

from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import envs_jax
from hmasd_jax.baselines.mappo import MAPPOConfig
from hmasd_jax.baselines.mappo import algorithm as mappo
from hmasd_jax.exploration.bonus import NO_BONUS, Bonus, add, solved_step_factor
from hmasd_jax.exploration.frontier import FrontierConfig
from hmasd_jax.exploration.successes import NO_IMITATION
from hmasd_jax.rl.ppo import PPOConfig
from tests.helpers.algorithms import lower_all
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


@pytest.mark.parametrize(("unsolved", "factor"), [(1.0, 1.0), (0.5, 0.95), (0.0, 0.2)])
def test_steps_shorten_once_all_copies_succeed(unsolved, factor):
    """The chance that all four copies win is 1 / 16 where half of the episodes are solved."""
    counting = NO_BONUS._replace(unsolved=lambda share: share)
    assert_allclose(solved_step_factor(counting, jnp.float32(unsolved), 4, 0.2), factor, rtol=1e-6)


def test_without_shorter_steps_nothing_is_traced():
    """A constant that becomes traced rounds the whole update differently."""
    counting = NO_BONUS._replace(unsolved=lambda share: share)
    assert type(solved_step_factor(counting, jnp.float32(0.5), 4, 1.0)) is float


@pytest.fixture(scope="module")
def parts():
    ppo = PPOConfig(num_envs=4, rollout_length=10, num_epochs=2, hidden_size=8)
    config = MAPPOConfig(entropy_coef=0.5, ppo=ppo)
    return mappo.make_parts(envs_jax.make("probe_match_cue"), config)


@pytest.fixture(scope="module")
def fresh(parts):
    return jax.jit(lambda key: mappo.init_state(parts, key))(jax.random.key(0))


def update_of(parts):
    """Return one jitted update of MAPPO."""
    return jax.jit(lambda state: mappo.train_iteration(parts, state)[0])


@pytest.mark.parametrize(("weight", "entropy_coef"), [(0.0, 0.0), (1.0, 0.5), (0.5, 0.25)])
def test_the_entropy_of_mappo_is_weighted_by_the_bonus(parts, fresh, weight, entropy_coef):
    fading = replace(parts, bonus=parts.bonus._replace(entropy_weight=lambda _: weight))
    fixed = replace(parts, config=replace(parts.config, entropy_coef=entropy_coef))
    faded, constant = (update_of(one)(fresh).learner.params for one in (fading, fixed))
    jax.tree.map(assert_array_equal, faded, constant)


def test_a_factor_of_zero_stops_mappo_on_a_solved_task(parts, fresh):
    """Imitation stops, too. The normalizer and Adam's moments go on."""
    config = replace(parts.config, frontier=FrontierConfig(coef=1.0), solved_step_factor=0.0)
    imitation = NO_IMITATION._replace(train=lower_all)

    def after_update(unsolved):
        bonus = parts.bonus._replace(unsolved=lambda _: jnp.float32(unsolved))
        return update_of(replace(parts, config=config, bonus=bonus, imitation=imitation))(fresh)

    stopped, moved = after_update(0.0), after_update(1.0)
    jax.tree.map(assert_array_equal, stopped.learner.params, fresh.learner.params)
    jax.tree.map(assert_array_equal, stopped.norm, moved.norm)
    with pytest.raises(AssertionError):
        chex.assert_trees_all_close(moved.learner.params, fresh.learner.params, rtol=1e-3)
    with pytest.raises(AssertionError):
        chex.assert_trees_all_close(stopped.learner.opt_state, fresh.learner.opt_state, rtol=1e-3)


@pytest.mark.parametrize(("name", "value"), [("solved_step_factor", 0.5), ("sharpening", 2.0)])
def test_what_changes_on_solved_tasks_needs_a_count_of_them(name, value):
    with pytest.raises(ValueError, match=rf"{name} {value} needs frontier.coef above 0"):
        MAPPOConfig(**{name: value})


@pytest.mark.parametrize("other", [constant(2.0, "a"), NO_BONUS])
def test_no_bonus_adds_nothing(other):
    assert add(NO_BONUS, other) is other
    assert add(other, NO_BONUS) is other
