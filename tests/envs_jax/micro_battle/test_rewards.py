"""Rewards of micro_battle by hand arithmetic."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_jax.micro_battle import MicroBattle, Scenario, Spawn
from envs_jax.micro_battle.constants import unit_constants
from envs_jax.micro_battle.rewards import team_reward

# Two marines of 45 points against a marine and a stalker of 80, with a shield of 80.
BATTLE = Scenario(
    allies=(Spawn("marine", 3.0, 3.0), Spawn("marine", 5.0, 3.0)),
    enemies=(Spawn("marine", 3.0, 8.0), Spawn("stalker", 5.0, 8.0)),
    floor=((0, 0, 16, 16),),
)
UNITS = MicroBattle(BATTLE).reset(jax.random.key(0))[0].units
MOST = 200 + 2 * 10 + 45 + 160  # The battle, two kills, and all points of the enemies.


def units(*health, shield=80.0):
    """Return the start, with the health of all units and the stalker's shield changed."""
    return UNITS._replace(
        health=jnp.array(health, float), shield=jnp.array([0.0, 0.0, 0.0, shield])
    )


def reward(kind, before, after):
    constants = unit_constants(BATTLE, "multi")
    return float(team_reward(kind, before, after, constants, 2))


START, WON = units(45, 45, 45, 80), units(0, 10, 0, 0, shield=0.0)
CASES = {
    "a hit": (START, units(45, 45, 39, 80), 0, 0, 6),
    "a hit on the shield": (START, units(45, 45, 45, 80, shield=70.0), 0, 0, 10),
    "a kill": (START, units(45, 45, 0, 80), 0, 10, 10 + 45),
    "a loss": (START, units(45, -2, 45, 80), 0, -5, 0),
    "both at once": (START, units(0, 45, -3, 80), 0, 10 - 5, 10 + 45),
    "a shield that recharges": (units(45, 45, 45, 80, shield=50.0), START, 0, 0, 30),
    "the last kill": (units(0, 10, 0, 4, shield=0.0), WON, 1, 200 + 10, 200 + 10 + 4),
    "all die at once": (units(0, 10, 0, 4, shield=0.0), units(0, 0, 0, 0, shield=0.0), 0, 5, 14),
    "after the end": (WON, WON, 0, 0, 0),
}


@pytest.mark.parametrize(
    ("before", "after", "win", "kills", "damage"), CASES.values(), ids=CASES.keys()
)
def test_points_of_a_step(before, after, win, kills, damage):
    assert reward("win", before, after) == win
    assert reward("kills", before, after) == pytest.approx(kills * 10 / MOST, abs=1e-6)
    assert reward("damage", before, after) == pytest.approx(damage * 20 / MOST, abs=1e-6)


def test_copies_are_rewarded_one_by_one():
    pairs = [case[:2] for case in CASES.values()]
    before, after = (jax.tree.map(lambda *x: jnp.stack(x, -1), *side) for side in zip(*pairs))
    constants = unit_constants(BATTLE, "multi", 1)
    for kind in ("win", "kills", "damage"):
        together = team_reward(kind, before, after, constants, 2)
        np.testing.assert_allclose(together, [reward(kind, *pair) for pair in pairs], atol=1e-6)


@pytest.mark.parametrize("kind", ["kills", "damage"])
def test_an_episode_earns_what_its_steps_say(kind):
    env = MicroBattle("3m", reward=kind)
    step, constants = jax.jit(env.step), unit_constants(env.resolved_scenario, "multi")
    state, timestep = env.reset(jax.random.key(1))
    assert timestep.reward == 0
    earned, expected = 0.0, 0.0
    while not timestep.done:  # All attack the first enemy in reach, else walk towards the enemies.
        mask = timestep.action_mask
        action = jnp.where(mask[:, 6:].any(-1), 6 + mask[:, 6:].argmax(-1), 4)
        action = jnp.where(mask[:, 0], 0, action)
        before = state.units
        state, timestep = step(jax.random.key(0), state, action)
        earned += float(timestep.reward)
        expected += float(team_reward(kind, before, state.units, constants, 3))
    assert earned == pytest.approx(expected)
    if kind == "kills":
        kills, losses = 3 - timestep.info["enemies_alive"], 3 - timestep.info["allies_alive"]
        points = 200 * timestep.info["success"] + 10 * kills - 5 * losses
        assert earned == pytest.approx(float(points) * 10 / 365, abs=1e-5)


def test_an_unknown_reward_is_refused():
    with pytest.raises(ValueError, match="reward"):
        MicroBattle("3m", reward="kill")
