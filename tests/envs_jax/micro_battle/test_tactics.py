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
# (results/micro_battle/tactics.json), and those of an independent simulation of the same rules in
# NumPy (docs/environments/micro_battle.md), if it played the tactic.
WIN_RATES = [
    ("3m", "multi", "random", 0.0, 0.0, 0.0),
    ("3m", "multi", "attack else random", 0.0, 0.001, 0.001),
    ("3m", "multi", "walk, nearest", 0.0, 0.388, 0.4),
    ("3m", "multi", "hold, nearest", 0.0, 0.377, 0.4),
    ("3m", "multi", "hold, random target", 0.0, 0.149, 0.16),
    ("3m", "multi", "hold, weakest", 0.0, 0.792, 0.81),
    ("3m", "multi", "advance, first", 0.0, 0.873, None),
    ("3m", "multi", "advance, first", 0.1, 0.413, None),
    ("3m", "multi", "advance, middle first", 0.0, 0.953, 0.95),
    ("3m", "multi", "advance, middle first", 0.1, 0.491, 0.48),
    ("2m_vs_1z", "multi", "random", 0.0, 0.0, 0.0),
    ("2m_vs_1z", "multi", "walk, nearest", 0.0, 0.015, 0.02),
    ("2m_vs_1z", "multi", "hold, nearest", 0.0, 0.119, 0.11),
    ("2m_vs_1z", "multi", "attack else random", 0.0, 0.041, 0.04),
    ("2m_vs_1z", "multi", "alternate", 0.0, 1.0, 1.0),
    ("2m_vs_1z", "multi", "alternate", 0.1, 0.935, 0.93),
    ("2m_vs_1z", "multi", "alternate", 0.3, 0.358, 0.33),
    ("2s_vs_1sc", "multi", "random", 0.0, 0.0, 0.0),
    ("2s_vs_1sc", "multi", "attack else random", 0.0, 0.0, 0.0),
    ("2s_vs_1sc", "multi", "walk, nearest", 0.0, 0.0, 0.0),
    ("2s_vs_1sc", "multi", "swap", 0.0, 0.085, 0.07),
    ("2s_vs_1sc", "multi", "swap and rest", 0.0, 1.0, 1.0),
    ("2s_vs_1sc", "multi", "swap and rest", 0.1, 0.896, 0.87),
    ("2s_vs_1sc", "liberty", "swap", 0.0, 0.0, 0.0),
    ("2s_vs_1sc", "liberty", "swap and rest", 0.0, 0.969, 0.985),
    ("2s_vs_1sc", "liberty", "swap and rest", 0.1, 0.241, 0.29),
]


@pytest.mark.parametrize(
    ("scenario", "balance", "tactic", "noise", "expected", "in_numpy"), WIN_RATES
)
def test_win_rates(scenario, balance, tactic, noise, expected, in_numpy):
    assert in_numpy is None or abs(expected - in_numpy) <= 0.05
    won, late, *_ = player(scenario, balance)(tactic, noise, seed=1)
    # Three standard errors of both measurements, and a little for rates near 0 and 1.
    error = np.sqrt(max(expected * (1 - expected), 0.002) * (1 / EPISODES + 1 / 4000))
    assert abs(np.mean(won) - expected) <= 3 * error
    assert not (won & late).any()


@pytest.mark.parametrize(("balance", "in_numpy"), [("multi", 50.0), ("liberty", 90.0)])
def test_health_that_two_attacking_stalkers_leave_the_spine_crawler(balance, in_numpy):
    won, late, _, left = player("2s_vs_1sc", balance)("walk, nearest")
    assert not (won | late).any()
    assert abs(left.mean() - in_numpy) < 2


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
