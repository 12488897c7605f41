"""Some copies draw all skills at random once the task is solved."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.exploration.bonus import NO_BONUS
from hmasd_jax.exploration.frontier import FrontierConfig, make_frontier
from hmasd_jax.exploration.successes import ImitationConfig
from hmasd_jax.hmasd import algorithm
from hmasd_jax.hmasd.ablations import make_coordinator
from hmasd_jax.hmasd.batches import high_batch
from hmasd_jax.hmasd.components import make_parts
from hmasd_jax.hmasd.random_copies import judge_others, mark_random, replace_skills
from hmasd_jax.hmasd.rollout_phase import blank_assignment, collect

MARKED = jnp.array([False, False, True, True])


BY_COPY = NO_BONUS._replace(unsolved=lambda shares, copies=True: shares.mean(where=copies))
"""A bonus whose state is the share of unsolved episodes in each copy."""


def with_random_copies(config, count):
    return replace(config, solved_random_copies=count, frontier=FrontierConfig(coef=1.0))


@pytest.mark.parametrize(
    ("all_solved", "marked"), [(0.0, 0), (0.24, 0), (0.26, 1), (0.74, 1), (0.76, 2)]
)
def test_their_number_grows_with_the_chance_that_all_copies_succeed(config, all_solved, marked):
    unsolved = jnp.full(4, 1 - all_solved ** (1 / 4))
    marks = mark_random(with_random_copies(config, 2), BY_COPY, unsolved)
    np.testing.assert_array_equal(marks, np.arange(4) >= 4 - marked)


def test_episodes_with_random_skills_do_not_tell_whether_the_task_is_solved(parts, config):
    unsolved = jnp.array([0.125, 0.25, 0.25, 0.75])
    bonus = judge_others(BY_COPY, with_random_copies(config, 1))
    assert_allclose(bonus.unsolved(unsolved), 0.625 / 3)
    greedy = jnp.array([True, False, False, False])
    assert_allclose([bonus.unsolved(unsolved, x) for x in (greedy, ~greedy)], [0.125, 0.25])
    changed = make_parts(parts.env, with_random_copies(config, 2))
    plain = make_frontier(parts.env, changed.config.frontier, 4)
    state = plain.init(jax.random.key(0))
    state = jax.tree.map(lambda x: jax.random.uniform(jax.random.key(1), x.shape), state)
    first = jnp.arange(4) < 2
    assert_allclose(changed.bonus.unsolved(state), plain.unsolved(state, first))
    assert plain.unsolved(state) != plain.unsolved(state, first)


def test_without_the_setting_nothing_is_traced(config):
    none = with_random_copies(config, 0)
    assert mark_random(none, BY_COPY, jnp.zeros(4)) is False
    assert judge_others(BY_COPY, none) is BY_COPY


@pytest.mark.parametrize("kind", ["learned", "team_only"])
def test_every_legal_skill_has_the_same_chance(config, kind):
    config = replace(config, coordinator=kind, num_skills=2 if kind == "team_only" else 3)
    network = make_coordinator(config)
    marked = jnp.arange(4000) >= 1000
    fresh = blank_assignment((4000, 3))._replace(value=jnp.ones((4000, 3)))
    drawn = replace_skills(network, fresh, jax.random.key(0), marked)
    skills = np.asarray(drawn.skills)
    assert (skills[:1000] == 0).all()
    assert (drawn.value == 1).all()
    for token, count in enumerate((2, config.num_skills, config.num_skills)):
        shares = np.bincount(skills[1000:, token], minlength=count) / 3000
        assert_allclose(shares, np.full(count, 1 / count), atol=0.05)
    together = (skills[1000:, 1] == skills[1000:, 2]).mean()
    assert_allclose(together, 1 if kind == "team_only" else 1 / 3, atol=0.05)
    chance = [1 / 2, 1, 1] if kind == "team_only" else [1 / 2, 1 / 3, 1 / 3]
    assert_allclose(drawn.log_prob[1000:], np.tile(np.log(chance), (3000, 1)), atol=1e-5)


def test_marked_copies_draw_at_random_and_the_others_as_without(parts, trained, rollout):
    mixed = jax.jit(lambda *args: collect(parts, *args))(
        trained.coordinator.params, trained.discoverer.params, trained.env, trained.memory,
        jax.random.key(1), MARKED,
    )  # fmt: skip
    kept, sampled = (x.transitions.extras.assignment for x in (mixed, rollout))
    np.testing.assert_array_equal(kept.skills[:, :2], sampled.skills[:, :2])
    assert_allclose(kept.log_prob[:, :2], sampled.log_prob[:, :2], atol=1e-5)
    assert (kept.skills[:, 2:] != sampled.skills[:, 2:]).any()
    chance = np.broadcast_to([1 / 2, 1 / 3, 1 / 3], (20, 2, 3))
    assert_allclose(kept.log_prob[:, 2:], np.log(chance), atol=1e-5)
    # Skills that end a rollout are due again, so the next are random, too.
    assert_allclose(mixed.next_assignment.log_prob[2:], np.log(chance[0]), atol=1e-5)


def test_the_coordinator_does_not_learn_from_them(parts, trained, rollout):
    high = high_batch(
        parts, trained.coordinator.params, trained.coordinator_norm, rollout,
        jax.random.key(0), MARKED,
    )  # fmt: skip
    values = rollout.transitions.extras.assignment.value
    others, theirs = (values[:, x].reshape(-1, 3) for x in (slice(2), slice(2, 4)))
    assert all((value == others).all(-1).any() for value in high.assignment.value)
    assert not any((value == theirs).all(-1).any() for value in high.assignment.value)


def test_an_update_marks_the_same_copies_in_the_rollout_and_in_the_coordinators_batch(
    parts, trained, monkeypatch
):
    seen = []

    def record(function):
        return lambda *args: seen.append(args[-1]) or function(*args)

    monkeypatch.setattr(algorithm, "mark_random", lambda *_: MARKED)
    monkeypatch.setattr(algorithm, "collect", record(collect))
    monkeypatch.setattr(algorithm, "high_batch", record(high_batch))
    jax.eval_shape(lambda state: algorithm.train_iteration(parts, state), trained)
    assert [x is MARKED for x in seen] == [True, True]


def test_some_copies_are_left_to_the_coordinator(config):
    config = replace(
        config, frontier=FrontierConfig(coef=1.0), imitation=ImitationConfig(greedy_copies=1)
    )
    replace(config, solved_random_copies=2)
    with pytest.raises(ValueError, match=r"solved_random_copies must be .* 2, got 3"):
        replace(config, solved_random_copies=3)
