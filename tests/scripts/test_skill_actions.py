"""The script that records what skills do: its keys, and its summary of battles."""

import jax
import numpy as np
import pytest

from envs_jax.micro_battle import MicroBattle
from scripts import skill_actions
from tests.helpers.random_play import RANDOM

STEPS, COPIES, AGENTS = 8, 5, 2


@pytest.fixture(scope="module")
def battles():
    """Random play on 2m_vs_1z, with an error if a key is used twice."""
    env = MicroBattle("2m_vs_1z", time_limit=STEPS)
    with pytest.MonkeyPatch.context() as patch, jax.debug_key_reuse(True):
        patch.setattr(skill_actions, "COPIES", COPIES)
        return skill_actions.play_battles(env, RANDOM, jax.random.key(0))


def test_every_copy_is_played_for_the_time_limit(battles):
    assert battles.action.shape == (STEPS, COPIES, AGENTS)
    assert battles.outcome.done[-1].all()


def test_summary_counts_each_living_agent_once(battles):
    row = skill_actions.summarize(battles, num_enemies=1)
    assert row["episodes"] == COPIES
    assert row["episode_length"] == STEPS
    assert row["wins"] == row["enemies_killed"] == 0  # too few steps
    assert 0 < row["share_in_range"] < 1  # the zealot comes closer
    for shares in (row["in_range"], row["out_of_range"]):
        assert sum(shares.values()) == pytest.approx(1, abs=0.004)  # each share has three digits


def test_each_copy_counts_with_its_first_battle(battles):
    """A copy that wins after two steps counts once, as one that loses at the end does."""
    done = np.zeros_like(battles.outcome.done)
    done[1::2, 0] = done[-1] = True
    success = np.zeros(done.shape)
    success[:, 0] = 1
    info = battles.outcome.info | {"success": success}
    outcome = battles.outcome._replace(terminated=done, truncated=done & False, info=info)
    row = skill_actions.summarize(battles._replace(outcome=outcome), num_enemies=1)
    assert row["episodes"] == COPIES
    assert row["wins"] == 1 / COPIES
    assert row["episode_length"] == (2 + STEPS * (COPIES - 1)) / COPIES


def test_action_shares_by_hand():
    shares = skill_actions.action_shares(np.array([1, 1, 2, 6, 7, 8, 8, 8]))
    assert shares == {
        "stop": 0.25, "north": 0.125, "south": 0, "east": 0, "west": 0, "attack": 0.625,
    }  # fmt: skip


def test_attacks_and_other_actions_are_told_apart_by_what_is_legal(battles):
    mask = np.zeros_like(battles.timestep.action_mask)
    mask[..., 1] = True
    action = np.ones_like(battles.action)  # stop, except that
    mask[:2, :, 0, 6] = True  # agent 0 can attack during two of eight steps,
    action[:2, :, 0] = 6  # and does
    timestep = battles.timestep._replace(action_mask=mask)
    row = skill_actions.summarize(battles._replace(timestep=timestep, action=action), num_enemies=1)
    assert row["share_in_range"] == 2 / (STEPS * AGENTS)
    assert row["in_range"]["attack"] == 1
    assert row["out_of_range"]["stop"] == 1
