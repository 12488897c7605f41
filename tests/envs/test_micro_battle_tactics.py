"""Win rates of scripted players: the battles are as hard as docs/micro_battle.md says."""

import importlib.util
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from envs_jax.micro_battle import MicroBattle

EPISODES = 500


def _load_tactics():
    path = Path(__file__).with_name("battle_tactics.py")
    spec = importlib.util.spec_from_file_location("battle_tactics", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


tactics = _load_tactics()


@lru_cache
def player(scenario, balance):
    """Compiled once per scenario, for all tactics."""
    return tactics.make_play(MicroBattle(scenario, balance), EPISODES)


# Over 4000 episodes (results/micro_battle/tactics.json): scenario, balance, tactic, share of
# random actions, wins.
WIN_RATES = [
    ("3m", "multi", "random", 0.0, 0.0),
    ("3m", "multi", "attack else random", 0.0, 0.001),
    ("3m", "multi", "walk, nearest", 0.0, 0.331),
    ("3m", "multi", "hold, nearest", 0.0, 0.389),
    ("3m", "multi", "hold, random target", 0.0, 0.136),
    ("3m", "multi", "hold, weakest", 0.0, 0.781),
    ("3m", "multi", "advance, first", 0.0, 0.845),
    ("3m", "multi", "advance, first", 0.1, 0.396),
    ("2m_vs_1z", "multi", "random", 0.0, 0.0),
    ("2m_vs_1z", "multi", "walk, nearest", 0.0, 0.017),
    ("2m_vs_1z", "multi", "hold, nearest", 0.0, 0.123),
    ("2m_vs_1z", "multi", "attack else random", 0.0, 0.041),
    ("2m_vs_1z", "multi", "alternate", 0.0, 1.0),
    ("2m_vs_1z", "multi", "alternate", 0.1, 0.936),
    ("2m_vs_1z", "multi", "alternate", 0.3, 0.347),
    ("2s_vs_1sc", "multi", "random", 0.0, 0.0),
    ("2s_vs_1sc", "multi", "attack else random", 0.0, 0.0),
    ("2s_vs_1sc", "multi", "walk, nearest", 0.0, 0.0),
    ("2s_vs_1sc", "multi", "swap", 0.0, 0.003),
    ("2s_vs_1sc", "multi", "swap and rest", 0.0, 1.0),
    ("2s_vs_1sc", "multi", "swap and rest", 0.1, 0.930),
    ("2s_vs_1sc", "liberty", "swap", 0.0, 0.0),
    ("2s_vs_1sc", "liberty", "swap and rest", 0.0, 0.96),
    ("2s_vs_1sc", "liberty", "swap and rest", 0.1, 0.268),
]


@pytest.mark.parametrize(("scenario", "balance", "tactic", "noise", "expected"), WIN_RATES)
def test_win_rates(scenario, balance, tactic, noise, expected):
    won, late, _ = player(scenario, balance)(tactic, noise, seed=1)
    # Three standard errors of both measurements, and a little for rates near 0 and 1.
    error = np.sqrt(max(expected * (1 - expected), 0.002) * (1 / EPISODES + 1 / 4000))
    assert abs(np.mean(won) - expected) <= 3 * error
    assert not (won & late).any()


@pytest.mark.parametrize(
    ("scenario", "tactic", "least"),
    [
        ("3m", "hide in the corner", 0.99),
        ("2m_vs_1z", "hide at the bottom", 0.95),
        ("2s_vs_1sc", "hide in the corner", 0.99),
    ],
)
def test_enemies_do_not_hunt_who_hides(scenario, tactic, least):
    won, late, steps = player(scenario, "multi")(tactic)
    assert np.mean(late) >= least
    assert not won.any()
    assert (np.asarray(steps)[np.asarray(late)] == MicroBattle(scenario).max_steps).all()
