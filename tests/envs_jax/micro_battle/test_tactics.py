"""Win rates of scripted players, as docs/environments/micro_battle.md states them."""

from functools import lru_cache

import numpy as np
import pytest

from envs_jax.micro_battle import MicroBattle
from scripts import tactics

EPISODES = 500


@lru_cache
def player(scenario, balance):
    """Compile the battle once per scenario, for all tactics."""
    return tactics.make_play(MicroBattle(scenario, balance), EPISODES)


# Scenario, balance, tactic, share of random actions; wins over 4000 episodes
# (results/micro_battle/tactics.json).
WIN_RATES = [
    ("3m", "multi", "random", 0.0, 0.0),
    ("3m", "multi", "attack else random", 0.0, 0.001),
    ("3m", "multi", "walk, nearest", 0.0, 0.388),
    ("3m", "multi", "hold, nearest", 0.0, 0.377),
    ("3m", "multi", "hold, random target", 0.0, 0.149),
    ("3m", "multi", "hold, weakest", 0.0, 0.792),
    ("3m", "multi", "advance, first", 0.0, 0.873),
    ("3m", "multi", "advance, first", 0.1, 0.413),
    ("3m", "multi", "advance, middle first", 0.0, 0.953),
    ("3m", "multi", "advance, middle first", 0.1, 0.491),
    ("2m_vs_1z", "multi", "random", 0.0, 0.0),
    ("2m_vs_1z", "multi", "walk, nearest", 0.0, 0.015),
    ("2m_vs_1z", "multi", "hold, nearest", 0.0, 0.119),
    ("2m_vs_1z", "multi", "attack else random", 0.0, 0.041),
    ("2m_vs_1z", "multi", "alternate", 0.0, 1.0),
    ("2m_vs_1z", "multi", "alternate", 0.1, 0.935),
    ("2m_vs_1z", "multi", "alternate", 0.3, 0.358),
    ("2s_vs_1sc", "multi", "random", 0.0, 0.0),
    ("2s_vs_1sc", "multi", "attack else random", 0.0, 0.0),
    ("2s_vs_1sc", "multi", "walk, nearest", 0.0, 0.0),
    ("2s_vs_1sc", "multi", "swap", 0.0, 0.085),
    ("2s_vs_1sc", "multi", "swap and rest", 0.0, 1.0),
    ("2s_vs_1sc", "multi", "swap and rest", 0.1, 0.896),
    ("2s_vs_1sc", "liberty", "swap", 0.0, 0.0),
    ("2s_vs_1sc", "liberty", "swap and rest", 0.0, 0.969),
    ("2s_vs_1sc", "liberty", "swap and rest", 0.1, 0.241),
]


@pytest.mark.parametrize(("scenario", "balance", "tactic", "noise", "expected"), WIN_RATES)
def test_win_rates(scenario, balance, tactic, noise, expected):
    won, late, *_ = player(scenario, balance)(tactic, noise, seed=1)
    # Three standard errors of both measurements, and a little for rates near 0 and 1.
    error = np.sqrt(max(expected * (1 - expected), 0.002) * (1 / EPISODES + 1 / 4000))
    assert abs(np.mean(won) - expected) <= 3 * error
    assert not (won & late).any()


@pytest.mark.parametrize(("balance", "expected"), [("multi", 50.0), ("liberty", 90.0)])
def test_health_that_two_attacking_stalkers_leave_the_spine_crawler(balance, expected):
    won, late, _, left = player("2s_vs_1sc", balance)("walk, nearest")
    assert not (won | late).any()
    assert abs(left.mean() - expected) < 2


@pytest.mark.parametrize(
    ("scenario", "tactic", "least"),
    [
        ("3m", "hide in the corner", 0.99),
        ("2m_vs_1z", "hide at the bottom", 0.95),
        ("2s_vs_1sc", "hide in the corner", 0.99),
    ],
)
def test_enemies_do_not_hunt_hidden_units(scenario, tactic, least):
    won, late, steps, _ = player(scenario, "multi")(tactic)
    assert np.mean(late) >= least
    assert not won.any()
    assert (np.asarray(steps)[np.asarray(late)] == MicroBattle(scenario).max_steps).all()
