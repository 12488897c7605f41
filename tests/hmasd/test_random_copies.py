"""Some copies draw all skills at random."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.exploration.bonus import NO_BONUS
from hmasd_jax.exploration.frontier import FrontierConfig
from hmasd_jax.exploration.successes import ImitationConfig
from hmasd_jax.hmasd.ablations import make_coordinator
from hmasd_jax.hmasd.batches import high_batch
from hmasd_jax.hmasd.coefficients import low_entropy_coef
from hmasd_jax.hmasd.random_copies import mark_random, replace_skills
from hmasd_jax.hmasd.rollout_phase import blank_assignment, collect


def with_random_copies(parts, count):
    return replace(parts, config=replace(parts.config, random_copies=count))


def test_the_last_copies_are_marked_and_without_the_setting_nothing_is_traced(config):
    marks = mark_random(replace(config, random_copies=2))
    np.testing.assert_array_equal(marks, [False, False, True, True])
    assert mark_random(config) is False


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


def test_they_draw_at_random_and_the_others_as_without(parts, trained, rollout):
    mixed = jax.jit(lambda *args: collect(with_random_copies(parts, 2), *args))(
        trained.coordinator.params, trained.discoverer.params, trained.env, trained.memory,
        jax.random.key(1),
    )  # fmt: skip
    kept, sampled = (x.transitions.extras.assignment for x in (mixed, rollout))
    np.testing.assert_array_equal(kept.skills[:, :2], sampled.skills[:, :2])
    assert_allclose(kept.log_prob[:, :2], sampled.log_prob[:, :2], atol=1e-5)
    assert (kept.skills[:, 2:] != sampled.skills[:, 2:]).any()
    chance = np.broadcast_to([1 / 2, 1 / 3, 1 / 3], (20, 2, 3))
    assert_allclose(kept.log_prob[:, 2:], np.log(chance), atol=1e-5)
    # New skills are due after the rollout, so these are random, too.
    assert_allclose(mixed.next_assignment.skills[:2], rollout.next_assignment.skills[:2])
    assert_allclose(mixed.next_assignment.log_prob[2:], np.log(chance[0]), atol=1e-5)


def test_the_coordinator_does_not_learn_from_them(parts, trained, rollout):
    high = high_batch(
        with_random_copies(parts, 2), trained.coordinator.params, trained.coordinator_norm,
        rollout, jax.random.key(0),
    )  # fmt: skip
    values = rollout.transitions.extras.assignment.value
    others, theirs = (values[:, x].reshape(-1, 3) for x in (slice(2), slice(2, 4)))
    assert all((value == others).all(-1).any() for value in high.assignment.value)
    assert not any((value == theirs).all(-1).any() for value in high.assignment.value)


def test_what_they_lose_is_not_laid_to_sampled_actions(parts):
    """The last copy may lose by its skills. The others lose 3 / 8 more than the greedy one."""
    shares = jnp.array([0.125, 0.5, 0.5, 0.875])
    bonus = NO_BONUS._replace(unsolved=lambda _, copies=True: shares.mean(where=copies))
    config = replace(
        parts.config, low_entropy_coef=0.4, sharpening=16.0, random_copies=1,
        frontier=FrontierConfig(coef=1.0), imitation=ImitationConfig(greedy_copies=1),
    )  # fmt: skip
    coef = low_entropy_coef(replace(parts, config=config, bonus=bonus), (), jnp.int32(0))
    assert_allclose(coef, 0.4 - 16 * 0.375 / 2**4, rtol=1e-5)


def test_some_copies_are_left_to_the_coordinator(config):
    config = replace(config, imitation=ImitationConfig(greedy_copies=1))
    replace(config, random_copies=2)
    with pytest.raises(ValueError, match=r"random_copies must be .* 2, got 3"):
        replace(config, random_copies=3)
