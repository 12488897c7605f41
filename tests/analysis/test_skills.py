"""Conditions, plays, tables and maps of skills, on a scripted policy with known results."""

import numpy as np
import pytest

from envs_jax.declared import name_actions
from hmasd_jax.analysis import skills, usefulness
from hmasd_jax.analysis.skill_space import occupancy, principal_components
from hmasd_jax.analysis.skills import FREE, Condition
from tests.helpers.scripted import scripted_run

EPISODES = 6


@pytest.fixture(scope="module")
def trained():
    return scripted_run()


@pytest.fixture(scope="module")
def study(trained):
    return skills.study_skills(trained, skills.make_player(trained, EPISODES))


def test_conditions_hold_and_remove_every_skill_that_has_an_alternative():
    found = skills.conditions(2, 3, num_agents=2)
    assert len(found) == len(set(found)) == 1 + 2 * 2 + 2 * 3 + 3 * 2
    assert {c.level for c in skills.conditions(1, 3, 2)} == {"individual"}
    assert skills.conditions(0, 0, 2) == [FREE]


@pytest.mark.parametrize(
    ("condition", "expected"),
    [
        (Condition("held", "team", 1), [[0, 1, 0], [1, 1, 1], [1, 1, 1]]),
        (Condition("removed", "team", 1), [[1, 0, 1], [1, 1, 1], [1, 1, 1]]),
        (Condition("held", "individual", 2), [[1, 1, 1], [0, 0, 1], [0, 0, 1]]),
        (Condition("removed", "individual", 2), [[1, 1, 1], [1, 1, 0], [1, 1, 0]]),
        (Condition("one agent", "individual", 0, 1), [[1, 1, 1], [1, 1, 1], [1, 0, 0]]),
        (FREE, [[1, 1, 1]] * 3),
    ],
)
def test_a_condition_allows_these_skills(condition, expected):
    np.testing.assert_array_equal(skills.allowed_skills(condition, 2, 3, 2), expected)


def test_episodes_are_cut_and_counted(study):
    free = study.plays[FREE]
    assert (free.returns == 1).all()
    assert (free.success == 1).all()
    assert ((free.lengths > 20) & (free.lengths <= 40)).all()
    np.testing.assert_array_equal(free.counted.sum(1), free.lengths)
    np.testing.assert_array_equal(free.chose.sum((1, 2)), 2 * free.lengths)
    assert free.events["red diamond collected"].sum() == EPISODES
    assert free.events["red diamond collected"][:, 1].all()  # Bob has z = 2 under Z = 0.
    assert free.events["blue button pressed"][:, 0].all()
    film = study.films[FREE]
    assert len(film.rewards) == free.lengths[0]
    assert set(study.films) == {c for c in study.plays if c.kind in ("free", "held")}


def test_held_skills_are_followed_from_the_same_starts(study):
    held = study.plays[Condition("held", "individual", 3)]
    assert (held.skills[..., 1:] == 3).all()
    one = study.plays[Condition("one agent", "individual", 3, 1)]
    assert (one.skills[..., 2] == 3).all()
    assert set(np.unique(one.skills[..., 1])) == {0, 1}
    starts = {c: film.env_states[0].position.tolist() for c, film in study.films.items()}
    assert len({str(start) for start in starts.values()}) == 1


def test_skills_of_alice_and_bob_earn_nothing_alone_but_all_are_needed(study):
    found = usefulness.measure_usefulness(study)
    assert [(e.level, e.skill) for e in found] == [
        ("team", 0), ("team", 1), *(("individual", z) for z in range(4))
    ]  # fmt: skip
    assert all(entry.useful and entry.needed and not entry.alone for entry in found)
    assert not any(entry.in_paper for entry in found)
    assert [tuple(entry.loss) for entry in found] == [(1.0, 1.0, 1.0)] * 6
    individual = found[2:]
    assert usefulness.share_useful(individual).value == 1.0
    assert usefulness.share_useful(individual, in_paper=True).value == 0.0
    assert usefulness.share_useful(individual).low < 0.6  # Four skills say little.


def test_usage_is_the_share_of_time(study):
    free = study.plays[FREE]
    team, individual = usefulness.usage(free, study)
    steps = free.lengths.sum()
    np.testing.assert_allclose(team, [[20 * EPISODES / steps, 1 - 20 * EPISODES / steps]])
    np.testing.assert_allclose(individual[0], [team[0, 1], team[0, 0], 0, 0])
    by_team = usefulness.usage_by_team_skill(free, study)
    np.testing.assert_array_equal(by_team[0], np.eye(4)[[1, 2]])
    np.testing.assert_array_equal(by_team[1], np.eye(4)[[0, 3]])
    never = usefulness.usage_by_team_skill(study.plays[Condition("removed", "team", 1)], study)
    assert np.isnan(never[1]).all()


def test_the_table_is_tidy(trained, study):
    rows = usefulness.table(study, name_actions(trained.env))
    assert len({tuple(row) for row in rows}) == 1  # the same columns everywhere
    keys = [
        tuple(row[k] for k in ("condition", "level", "skill", "agent", "measure")) for row in rows
    ]
    assert len(set(keys)) == len(keys)
    values = {key: row["value"] for key, row in zip(keys, rows)}
    assert values["free", None, None, None, "success"] == 1.0
    assert values["held", "individual", 0, None, "event: blue button pressed"] > 0
    assert values["one agent", "individual", 0, 1, "return"] == 0.0
    assert values["compared", "individual", 2, None, "useful"] == 1.0
    held = [v for k, v in values.items() if k[:3] == ("held", "team", 0) and "action: " in k[4]]
    assert sum(held) == pytest.approx(1.0)


def test_agents_are_where_their_skill_leads(trained, study):
    held = study.plays[Condition("held", "individual", 2)]
    picture = trained.env.render(study.films[FREE].env_states[0])
    shares = occupancy(held, picture.shape[:2], trained.env.cell_pixels)
    assert shares.shape == (10, 10)
    assert shares.sum() == pytest.approx(1.0)
    assert np.unravel_index(shares.argmax(), shares.shape) == (8, 1)  # the red diamond
    bob = occupancy(study.plays[FREE], picture.shape[:2], 32, agent=1)
    assert bob[8].sum() > bob[1].sum()


def test_principal_components_recover_a_plane():
    rng = np.random.default_rng(0)
    plane = rng.normal(size=(200, 2)) * [5.0, 2.0]
    turned = plane @ np.linalg.qr(rng.normal(size=(6, 6)))[0][:2] + 3.0
    points, explained = principal_components(turned)
    assert explained.sum() == pytest.approx(1.0)
    distances = [np.linalg.norm(x[:, None] - x, axis=-1) for x in (points, plane)]
    np.testing.assert_allclose(*distances, atol=1e-6)
    flat, _ = principal_components(np.arange(5.0)[:, None])
    assert flat.shape == (5, 2)
