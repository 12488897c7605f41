"""Coefficients that change once the task is solved, with MAPPO as the algorithm."""

from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import envs_jax
from hmasd_jax.baselines.mappo import MAPPOConfig
from hmasd_jax.baselines.mappo import algorithm as mappo
from hmasd_jax.exploration.bonus import NO_BONUS
from hmasd_jax.exploration.frontier_config import FrontierConfig
from hmasd_jax.exploration.solved import SolvedConfig, actions_entropy_coef, step_factor
from hmasd_jax.exploration.successes import NO_IMITATION, ImitationConfig
from hmasd_jax.rl.ppo import PPOConfig
from tests.helpers.algorithms import lower_all

COUNTS = FrontierConfig(coef=1.0)
COUNTING = NO_BONUS._replace(unsolved=lambda share: share)
"""Bonus whose state is the share of unsolved episodes."""


def settings(**changes):
    """Return settings for four copies, two of which act greedily."""
    return MAPPOConfig(
        ppo=PPOConfig(num_envs=4, rollout_length=10), frontier=COUNTS,
        imitation=ImitationConfig(greedy_copies=2), solved=SolvedConfig(**changes),
    )  # fmt: skip


@pytest.mark.parametrize(("unsolved", "factor"), [(1.0, 1.0), (0.5, 0.95), (0.0, 0.2)])
def test_steps_shorten_once_all_copies_succeed(unsolved, factor):
    """The chance that all four copies win is 1 / 16 where half of the episodes are solved."""
    config = settings(step_factor=0.2)
    assert_allclose(step_factor(COUNTING, jnp.float32(unsolved), config), factor, rtol=1e-6)


def test_without_shorter_steps_nothing_is_traced():
    """A constant that becomes traced rounds the whole update differently."""
    assert type(step_factor(COUNTING, jnp.float32(0.5), settings())) is float


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
    config = replace(parts.config, frontier=COUNTS, solved=SolvedConfig(step_factor=0.0))
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


@pytest.mark.parametrize(("name", "value"), [("step_factor", 0.5), ("sharpening", 2.0)])
def test_what_changes_on_solved_tasks_needs_a_count_of_them(name, value):
    with pytest.raises(ValueError, match=rf"^solved.{name} {value} needs frontier.coef above 0"):
        MAPPOConfig(solved=SolvedConfig(**{name: value}))


def counting(shares):
    """Return a bonus that knows the share of unsolved episodes of each copy."""
    return NO_BONUS._replace(
        entropy_weight=lambda _: 0.5,
        unsolved=lambda _, copies=True: jnp.array(shares).mean(where=copies),
    )


@pytest.mark.parametrize(
    ("unsolved", "coef"),
    [
        ([0.0, 0.0, 0.0, 0.0], 0.15),  # sampling loses nothing
        ([0.0, 0.0, 1.0, 1.0], 0.15 - 3.2 * 1.0 / 16),  # all that greedy copies win, of a half
        ([0.25, 0.25, 0.75, 0.75], 0.15 - 3.2 * 0.5 / 16),
        ([1.0, 1.0, 0.0, 0.0], 0.15),  # sampling wins more
    ],
)
def test_actions_become_sure_as_far_as_sampling_loses_what_is_solved(unsolved, coef):
    """Half of 0.3, and less by the share that sampling loses times the chance that all win."""
    config = settings(sharpening=3.2)
    assert_allclose(actions_entropy_coef(counting(unsolved), (), config, 0.3), coef, rtol=1e-6)
    plain = settings()
    assert type(actions_entropy_coef(counting(unsolved), (), plain, 0.3)) is float


def test_sharpening_needs_copies_that_act_greedily():
    match = r"^solved.sharpening 2.0 needs imitation.greedy_copies above 0"
    with pytest.raises(ValueError, match=match):
        MAPPOConfig(solved=SolvedConfig(sharpening=2.0), frontier=COUNTS)


@pytest.mark.parametrize(("sharpening", "entropy_coef"), [(0.0, 0.25), (4.0, 0.125)])
def test_mappo_trains_with_the_coefficient_that_sharpening_leaves(sharpening, entropy_coef):
    """Two copies act greedily and win, and the others lose a quarter of their episodes."""
    ppo = PPOConfig(num_envs=4, rollout_length=10, num_epochs=2, hidden_size=8)
    imitation = ImitationConfig(greedy_copies=2)
    config = MAPPOConfig(entropy_coef=0.5, ppo=ppo, imitation=imitation)
    parts = mappo.make_parts(envs_jax.make("probe_match_cue"), config)
    state = jax.jit(lambda key: mappo.init_state(parts, key))(jax.random.key(0))

    def update(parts):
        return jax.jit(lambda state: mappo.train_iteration(parts, state)[0])(state).learner.params

    bonus = parts.bonus._replace(
        entropy_weight=lambda _: 0.5,
        unsolved=lambda _, copies=True: jnp.array([0.0, 0.0, 0.25, 0.25]).mean(where=copies),
    )
    # The chance that all four win is (1 - 1/8)^4.
    sharper = sharpening / (1 - 1 / 8) ** 4 / 8
    sure = replace(config, frontier=COUNTS, solved=SolvedConfig(sharpening=sharper))
    fixed = replace(parts, config=replace(config, entropy_coef=entropy_coef))
    chex.assert_trees_all_close(
        update(replace(parts, config=sure, bonus=bonus)), update(fixed), rtol=1e-5, atol=1e-6
    )
