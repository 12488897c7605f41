"""The script that records by how much battles are won and lost."""

import jax
import numpy as np
import pytest

from envs_jax.micro_battle import MicroBattle
from hmasd_jax.runs.load import TrainedRun
from hmasd_jax.types import Algorithm
from scripts import lost_battles
from tests.helpers.random_play import RANDOM


def test_battles_cut_short_leave_the_enemy_its_health(monkeypatch):
    algorithm = Algorithm(None, None, lambda state, greedy: RANDOM)
    env = MicroBattle("2m_vs_1z", time_limit=3)
    run = TrainedRun(config=None, env=env, algorithm=algorithm, state=None, env_steps=7)
    monkeypatch.setattr(lost_battles, "load_run", lambda path, seed: run)
    monkeypatch.setattr(lost_battles, "BATTLES", 4)
    row = lost_battles.measure("run", 5)
    health = float(env.reset(jax.random.key(0))[0].units.health[2])
    assert row["won"] == 0
    assert row["seed"] == 5
    assert row["env_steps"] == 7
    assert row["health left"]["100"] == pytest.approx(health)
    assert "allies left" not in row


def test_targets_of_several_attacks_are_compared():
    """Actions 6 and 7 attack; the third step has one attack only."""
    actions = np.array([[6, 6, 0], [6, 7, 1], [1, 7, 2], [7, 7, 7]])
    assert lost_battles.share_of_same_targets(actions) == pytest.approx(2 / 3, abs=1e-3)
    assert lost_battles.share_of_same_targets(actions[2:3]) is None
