"""Some segments of a solved task draw all skills at random."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.exploration.bonus import NO_BONUS
from hmasd_jax.exploration.frontier_config import FrontierConfig
from hmasd_jax.exploration.successes import ImitationConfig
from hmasd_jax.hmasd.ablations import make_coordinator
from hmasd_jax.hmasd.coefficients import random_share
from hmasd_jax.hmasd.config import SolvedSkillsConfig
from hmasd_jax.hmasd.random_segments import mark_random, replace_skills
from hmasd_jax.hmasd.rollout_phase import blank_assignment, collect


def with_random_segments(parts, share=0.5, greedy_copies=0):
    config = replace(
        parts.config, solved=SolvedSkillsConfig(random_share=share),
        frontier=FrontierConfig(coef=1.0),
        imitation=ImitationConfig(greedy_copies=greedy_copies),
    )  # fmt: skip
    return replace(parts, config=config)


def test_their_share_grows_with_the_chance_that_all_copies_succeed(parts):
    """Half of the episodes are solved: a chance of 1 / 16 for four copies."""
    bonus = NO_BONUS._replace(unsolved=lambda share, copies=True: share)
    some = replace(with_random_segments(parts, 0.25), bonus=bonus)
    shares = [random_share(some, jnp.float32(x)) for x in (1.0, 0.5, 0.0)]
    assert_allclose(shares, [0, 0.25 / 16, 0.25])


def test_without_the_setting_nothing_is_traced(parts):
    share = random_share(parts, jnp.float32(0))
    assert share == 0.0
    assert type(share) is float
    assert mark_random(parts.config, share, jax.random.key(0)) is False


def test_copies_are_marked_with_that_chance_unless_they_act_greedily(parts):
    config = with_random_segments(parts, 0.9, greedy_copies=1).config
    keys = jax.random.split(jax.random.key(0), 2000)
    marked = jax.vmap(lambda key: mark_random(config, 0.3, key))(keys)
    assert not marked[:, 0].any()
    assert_allclose(marked[:, 1:].mean(0), [0.3] * 3, atol=0.04)
    # Each copy draws for itself.
    assert_allclose((marked[:, 1] & marked[:, 2]).mean(), 0.09, atol=0.03)


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


def test_the_coordinator_learns_from_the_segments_that_it_chose(parts, trained, rollout):
    """Skills of the others are random, and last for the whole segment."""
    mixed = jax.jit(lambda *args: collect(with_random_segments(parts), *args))(
        trained.coordinator.params, trained.discoverer.params, trained.env, trained.memory,
        jax.random.key(1), 0.5,
    )  # fmt: skip
    extras, plain = (x.transitions.extras for x in (mixed, rollout))
    begins, sampled = np.asarray(extras.renewed), np.asarray(extras.sampled)
    random = begins & ~sampled
    assert random.any()
    assert sampled.any()
    assert not (sampled & ~begins).any()
    log_prob = np.asarray(extras.assignment.log_prob)
    chance = np.log([1 / 2, 1 / 3, 1 / 3])
    assert_allclose(log_prob[random], np.tile(chance, (random.sum(), 1)), atol=1e-5)
    assert (np.abs(log_prob[sampled] - chance) > 1e-4).any(-1).all()
    # The first segments start alike, so that what is chosen is what would be without.
    chosen = sampled[0]
    skills, same = (x.assignment.skills[0] for x in (extras, plain))
    np.testing.assert_array_equal(skills[chosen], same[chosen])
    kept = np.asarray(extras.assignment.skills).reshape(4, 5, *skills.shape)
    np.testing.assert_array_equal(kept, np.repeat(kept[:, :1], 5, axis=1))
