"""The bonus for values of single features that few episodes reach."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import envs_jax
from hmasd_jax.exploration.bonus import NO_BONUS
from hmasd_jax.exploration.frontier import (
    explore,
    find_bins,
    is_success,
    make_frontier,
    rise,
    unsolved,
    widen,
)
from hmasd_jax.exploration.frontier_config import FrontierConfig
from tests.helpers.rollouts import outcome_of

ENV = envs_jax.make("probe_match_cue")
SIZE = ENV.state_dim
NUM_ENVS = 4
CONFIG = FrontierConfig(coef=0.5, num_bins=4, window=10, forgetting=0.0)


reach = jax.jit(lambda frontier, outcome: explore(frontier, outcome, CONFIG)[:2])


@pytest.fixture(scope="module")
def bonus():
    pure = make_frontier(ENV, CONFIG, NUM_ENVS)
    return pure._replace(update=jax.jit(pure.update))


@pytest.fixture
def empty(bonus):
    return bonus.init(jax.random.key(0))


def rollout_of(*episodes, done_at_end=True):
    """Return a rollout, one episode per copy, whose first feature has these values."""
    values = jnp.array(episodes).T
    outcome = outcome_of(jnp.zeros((*values.shape, SIZE)).at[..., 0].set(values))
    return outcome._replace(terminated=outcome.terminated.at[-1].set(done_at_end))


def train(bonus, frontier, outcome, times=1):
    """Return the state after that many updates on the same rollout, and the last reward."""
    for _ in range(times):
        frontier, reward, _ = bonus.update(frontier, outcome, jax.random.key(0))
    return frontier, reward


RISES, FALLS = 0, 1


def test_a_step_passes_nothing_between_episodes_but_does_between_rollouts(bonus, empty):
    """From 4 to 0 by a reset; then from 0 to 4 at the first step of the next rollout."""
    outcome = rollout_of(*[[0.0, 4.0, 0.0]] * 4, done_at_end=False)
    outcome = outcome._replace(terminated=outcome.terminated.at[1].set(True))
    wide = empty._replace(low=jnp.zeros(SIZE), high=jnp.full(SIZE, 4.0))
    frontier, is_first = reach(wide, outcome)
    assert not is_first[2].any()
    _, is_first = reach(frontier, rollout_of(*[[4.0]] * 4))
    assert_array_equal(is_first[0, 0, RISES, 0], [False, True, True, True])
    assert not is_first[:, :, FALLS].any()


def test_an_episode_goes_on_in_the_next_rollout(bonus, empty):
    """To 4 and back; in the next rollout there again, which pays nothing."""
    frontier, _ = train(bonus, empty, rollout_of(*[[0.0, 4.0, 0.0]] * 4, done_at_end=False))
    frontier, is_first = reach(frontier, rollout_of(*[[4.0, 0.0]] * 4))
    assert not is_first.any()
    _, is_first = reach(frontier, rollout_of(*[[0.0, 4.0]] * 4))
    assert_array_equal(is_first[1, 0, RISES, 0], [False, True, True, True])


def test_the_share_counts_episodes_and_not_steps(empty):
    """One of four episodes reaches 4, and stays there."""
    outcome = rollout_of([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 4.0, 4.0])
    frontier, _ = reach(empty._replace(parts=jnp.zeros(NUM_ENVS)), outcome)
    assert_allclose(frontier.mastered[RISES, 0], [0.0, 0.25, 0.25, 0.25])
    assert_allclose(frontier.mastered[FALLS], 0.0)


def test_the_share_is_an_average_over_the_window(empty):
    outcome = rollout_of(*[[0.0, 4.0]] * 4)
    frontier, _ = reach(empty, outcome)
    assert_allclose(frontier.episodes.sum(), NUM_ENVS * 0.9 + 4)
    assert_allclose(frontier.reached[RISES, 0], [0, 4, 4, 4])
    assert_allclose(frontier.mastered[RISES, 0, 1], 4 / 7.6, rtol=1e-6)


def test_a_long_episode_counts_as_several(empty):
    """Two games of 4 steps reach 4 once, in one of their two parts; the others, in each part."""
    outcome = rollout_of(*[[0.0, 4.0, 0.0, 0.0]] * 2, *[[0.0, 4.0, 0.0, 4.0]] * 2)
    nothing = empty._replace(parts=jnp.zeros(NUM_ENVS), episodes=jnp.zeros(NUM_ENVS))
    for period, share, parts in ((0, 1.0, 4), (2, 6 / 8, 8)):
        frontier, *_ = explore(nothing, outcome, dataclasses.replace(CONFIG, period=period))
        assert_allclose(frontier.mastered[RISES, 0, 1], share)
        assert (frontier.parts.sum(), frontier.episodes.sum()) == (parts, 4)


def test_a_part_goes_on_in_the_next_rollout(empty):
    """Parts have 3 steps. The first rollout has two of them."""
    in_parts = dataclasses.replace(CONFIG, period=3)
    frontier, *_ = explore(empty, rollout_of(*[[0.0, 4.0]] * 4, done_at_end=False), in_parts)
    rest = rollout_of(*[[0.0, 4.0, 0.0, 4.0]] * 4, done_at_end=False)
    _, is_first, _ = explore(frontier, rest, in_parts)
    assert_array_equal(is_first[:, 0, FALLS, 0, 0], [True, False, True, False])
    assert_array_equal(is_first[:, 0, RISES, 0, 3], [False, True, False, False])


def test_a_feature_is_paid_for_all_its_values_over_the_root_of_their_number(bonus, empty):
    """Three copies rise to 2, of which one goes on to 4, and the fourth rises to 4 at once."""
    outcome = rollout_of([0.0, 2.0, 4.0], [0.0, 4.0, 4.0], [0.0, 2.0, 2.0], [0.0, 2.0, 2.0])
    frontier, reward = train(bonus, empty, outcome)
    assert_allclose(frontier.mastered[RISES, 0, 1:], [4 / 7.6, 4 / 7.6, 2 / 7.6], rtol=1e-6)
    near, far = 7.6 / 4 - 1, 7.6 / 2 - 1
    # The bins of 1 and 2 are near, and that of 4 is far.
    two, three = 2 * near / 2**0.5, (2 * near + far) / 3**0.5
    paid = jnp.array([[0, 0, 0, 0], [two, three, two, two], [far, 0, 0, 0]])
    assert_allclose(reward, 0.5 * (paid - paid.mean()) / paid.std(), rtol=1e-4)


def test_the_bonus_is_the_sum_over_features(bonus, empty):
    values = jnp.zeros((2, NUM_ENVS, SIZE)).at[1, 3].set(4.0)
    outcome = outcome_of(values)
    outcome = outcome._replace(terminated=outcome.terminated.at[-1].set(True))
    frontier, _ = train(bonus, empty, outcome)
    assert_allclose(frontier.bonuses.mean, SIZE * 3**0.5 * (7.6 - 1) / 8, rtol=1e-5)


def test_the_bonus_fades_with_the_chance_that_no_copy_wins(bonus, empty):
    outcome = rollout_of([0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 4.0])
    wins = outcome._replace(reward=outcome.reward.at[1, :3].set(1.0))
    _, without = train(bonus, empty, outcome)
    frontier, reward = train(bonus, empty, wins)
    # Three of the four episodes, beside 0.9 x 4 that count as recent at the start.
    assert_allclose(unsolved(frontier), 1 - 3 / 7.6, rtol=1e-6)
    assert_allclose(reward, (1 - 3 / 7.6) ** NUM_ENVS * without, rtol=1e-5)


def test_the_step_of_a_success_is_counted_but_not_paid(bonus, empty):
    """Two copies rise to 4: one is rewarded, and one is not."""
    outcome = rollout_of([0.0, 0.0], [0.0, 0.0], [0.0, 4.0], [0.0, 4.0])
    wins = outcome._replace(reward=outcome.reward.at[1, 2].set(1.0))
    frontier, reward = train(bonus, empty, wins)
    assert_allclose(frontier.mastered[RISES, 0, 1:], 2 / 7.6, rtol=1e-6)
    assert_allclose(reward[1, 2], reward[1, 0])
    assert reward[1, 3] > 0 > reward[1, 2]
    assert_allclose(frontier.bonuses.mean, 3**0.5 * (7.6 / 2 - 1) / 8, rtol=1e-5)


@pytest.mark.parametrize(("fade_entropy", "weight"), [(True, 0.25), (False, 1.0)])
def test_the_entropy_fades_with_the_share_of_won_episodes_if_asked(fade_entropy, weight, empty):
    bonus = make_frontier(ENV, dataclasses.replace(CONFIG, fade_entropy=fade_entropy), NUM_ENVS)
    won = empty._replace(successes=jnp.array([2.0, 1, 2, 1]), episodes=jnp.array([2.0, 2, 2, 2]))
    assert bonus.entropy_weight(won) == weight
    assert bonus.unsolved(won) == 0.25


def test_solved_episodes_are_counted_for_each_copy(bonus, empty):
    """One copy of two wins its first episode, beside 0.9 of an episode that counts at the start."""
    outcome = rollout_of(*[[0.0, 4.0]] * NUM_ENVS)
    frontier, _ = train(bonus, empty, outcome._replace(reward=outcome.reward.at[1, 1].set(1.0)))
    for copies, won in [([0, 2, 3], 0), ([1], 1 / 1.9), ([0, 1], 1 / 3.8)]:
        marked = jnp.zeros(NUM_ENVS, bool).at[jnp.array(copies)].set(True)
        assert_allclose(unsolved(frontier, marked), 1 - won, rtol=1e-6)


def test_an_environment_that_reports_success_says_which_episodes_are_solved():
    """A lost battle whose last step pays for damage, a win, a step within an episode, and time."""
    ends, in_time = [True, True, False, False], [False, False, False, True]
    paid, won = [1.0, 1.0, 1.0, 1.0], [0.0, 1.0, 1.0, 1.0]
    terminated, truncated, reward, success = (jnp.array([x]) for x in (ends, in_time, paid, won))
    outcome = rollout_of(*[[0.0]] * 4)
    outcome = outcome._replace(terminated=terminated, truncated=truncated, reward=reward)
    assert_array_equal(is_success(outcome), [[True, True, False, False]])
    outcome = outcome._replace(info={"success": success})
    assert_array_equal(is_success(outcome), [[False, True, False, True]])


def test_a_window_without_an_end_of_an_episode_is_unsolved():
    bonus = make_frontier(ENV, dataclasses.replace(CONFIG, window=1), NUM_ENVS)
    outcome = rollout_of(*[[0.0, 4.0, 0.0]] * 4, done_at_end=False)
    frontier, reward = train(bonus, bonus.init(jax.random.key(0)), outcome)
    assert unsolved(frontier) == 1.0
    assert jnp.isfinite(reward).all()


def test_where_time_ends_every_episode_the_bonus_goes_on_in_units_of_the_best_return(bonus, empty):
    outcome = rollout_of([0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 4.0])
    _, without = train(bonus, empty, outcome)
    in_time = outcome._replace(
        terminated=jnp.zeros_like(outcome.terminated), truncated=outcome.terminated
    )
    paid = in_time._replace(reward=jnp.full_like(outcome.reward, 20.0))
    frontier, reward = train(bonus, empty, paid)
    assert (frontier.successes == 0).all()
    # Eight rewards in four episodes, beside 0.9 x 4 that count as recent and got nothing.
    assert_allclose(frontier.best_return, 8 * 20 / 7.6, rtol=1e-6)
    assert_allclose(reward, 8 * 20 / 7.6 * without, rtol=1e-5)
    later, _ = train(bonus, frontier, in_time, times=30)
    assert later.returns < 0.1 * frontier.returns
    assert later.best_return == frontier.best_return


def test_small_odds_are_not_paid_like_large_ones(bonus, empty):
    """One of four copies rises to 1, as half of the episodes did before."""
    known = empty._replace(low=jnp.zeros(SIZE), high=jnp.full(SIZE, 4.0))
    known = known._replace(mastered=jnp.full_like(known.mastered, 0.5))
    _, reward = train(bonus, known, rollout_of([0.0, 1.0], *[[0.0, 0.0]] * 3))
    # The odds are 1. One step of eight is paid them, and the mean is subtracted.
    assert_allclose(reward[1], 0.5 * (jnp.array([1, 0, 0, 0]) - 1 / 8), rtol=1e-5)


def test_the_bonus_fades_once_the_best_return_has_stopped_rising(empty):
    """Over 10 rollouts nine tenths of what the usual return lacks remain, each time."""
    patient = dataclasses.replace(CONFIG, patience=10, window=1)
    outcome = rollout_of(*[[0.0, 4.0]] * 4)
    frontier = empty._replace(episodes=jnp.zeros(NUM_ENVS))

    def play(frontier, earned, times):
        played = outcome._replace(reward=outcome.reward.at[1].set(earned))
        for _ in range(times):
            frontier, *_ = explore(frontier, played, patient)
        return frontier

    assert rise(frontier) == 1
    for earned, times, expected in ((0.5, 60, 1.0), (20.0, 28, 1.0), (20.0, 12, 20 * 0.9**40)):
        frontier = play(frontier, earned, times)
        assert_allclose(rise(frontier), expected, rtol=1e-4)
    assert rise(play(frontier, 40.0, 10)) == 1


def test_without_patience_the_bonus_does_not_fade(bonus, empty):
    outcome = rollout_of([0.0, 4.0], *[[0.0, 0.0]] * 3)
    earned = outcome._replace(reward=outcome.reward.at[1].set(20.0))
    frontier, _ = train(bonus, empty, earned, times=60)
    assert rise(frontier) == 1


def test_the_bonus_is_paid_as_far_as_the_best_return_rises(bonus, empty):
    outcome = rollout_of([0.0, 4.0], *[[0.0, 0.0]] * 3)
    _, reward = train(bonus, empty, outcome)
    _, less = train(bonus, empty._replace(usual_return=jnp.float32(0.98)), outcome)
    assert_allclose(less, 0.4 * reward, rtol=1e-5)


def test_what_was_mastered_pays_nothing_when_it_is_left(bonus, empty):
    wide = empty._replace(low=jnp.zeros(SIZE), high=jnp.full(SIZE, 8.0))
    mastered, _ = train(bonus, wide, rollout_of(*[[0.0, 4.0]] * 4), times=60)
    left, _ = train(bonus, mastered, rollout_of(*[[0.0, 0.0]] * 4), times=60)
    assert left.reached[RISES, 0, 2] < 0.1
    _, back = train(bonus, left, rollout_of([0.0, 4.0], *[[0.0, 6.0]] * 3))
    assert_allclose(back[1, 0], back[0, 0], atol=0.01)
    assert (back[1, 1:] > back[1, 0] + 0.1).all()


def test_what_was_mastered_and_lost_pays_again_later(empty):
    """The largest share falls by a tenth per rollout, down to the share of the moment."""
    forgetful = dataclasses.replace(CONFIG, window=1, forgetting=0.1)
    shares = []
    for values in ([0.0, 4.0], [0.0, 0.0], [0.0, 0.0]):
        empty, *_ = explore(empty, rollout_of(*[values] * 4), forgetful)
        shares.append(empty.mastered[RISES, 0, 3])
    assert_allclose(shares, [1, 0.9, 0.81], rtol=1e-6)


def test_a_wider_range_moves_what_is_known_to_the_bin_of_the_old_middle(empty):
    """Bins of [0, 4] have their middles at 0.5, 1.5, 2.5, 3.5; those of [0, 8] are 2 wide.

    No episode counts twice in a bin.
    """
    known = empty._replace(
        low=jnp.zeros(SIZE),
        high=jnp.full(SIZE, 4.0),
        reached=jnp.tile(jnp.array([2.0, 1, 0, 2]), (2, SIZE, 1)),
        mastered=jnp.tile(jnp.array([0.5, 0.25, 0, 0.125]), (2, SIZE, 1)),
    )
    wider = widen(known, jnp.zeros(SIZE), jnp.full(SIZE, 8.0))
    for direction in (RISES, FALLS):
        assert_allclose(wider.reached[direction, 0], [2, 2, 0, 0])
        assert_allclose(wider.mastered[direction, 0], [0.5, 0.125, 0, 0])
    assert_array_equal(find_bins(wider, jnp.full(SIZE, 3.9), CONFIG.num_bins), 1)


def test_without_a_weight_there_is_no_bonus():
    assert make_frontier(ENV, FrontierConfig(), NUM_ENVS) is NO_BONUS


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("coef", -1),
        ("num_bins", 1),
        ("largest_worth", -1),
        ("window", 0),
        ("forgetting", -1),
        ("period", -1),
        ("patience", -1),
    ],
)
def test_settings_out_of_range_are_refused(field, value):
    with pytest.raises(ValueError, match=f"{field} must be .*, got {value}"):
        FrontierConfig(**{field: value})
