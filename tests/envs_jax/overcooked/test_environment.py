"""Rules of Overcooked one by one, and the time limit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_jax.overcooked.environment import Overcooked, OvercookedState
from envs_jax.overcooked.layouts import read
from envs_jax.overcooked.rules import (
    COUNTER,
    DISH,
    NOTHING,
    ONION,
    POT,
    SOUP,
    pot_state,
)

NORTH, SOUTH, EAST, WEST, STAY, INTERACT = range(6)
KEY = jax.random.key(0)
# cramped_room has floor at x 1..3, y 1..2, a pot at (2, 0), onions at (0, 1) and (4, 1), dishes at
# (1, 3) and a serving window at (3, 3). All other cells are counters.
ENVS = {rule: Overcooked(start_cooking=rule, random_seats=False) for rule in ("interact", "auto")}
STEP = {rule: jax.jit(env.step) for rule, env in ENVS.items()}
KITCHEN = read("cramped_room")


def at(x, y):
    return 5 * y + x


def state(one, other, held=(NOTHING, NOTHING), time=0, **cells):
    """Make a state with two cooks at (x, y, orientation), and cell states such as p2_0=POT."""
    grid = KITCHEN.grid.copy()
    for name, code in cells.items():
        grid[at(*map(int, name[1:].split("_")))] = code
    pose = [4 * at(x, y) + orientation for x, y, orientation in (one, other)]
    return OvercookedState(
        pose=jnp.array(pose, jnp.int32),
        held=jnp.array(held, jnp.int32),
        grid=jnp.asarray(grid),
        time=jnp.int32(time),
        soups=jnp.int32(0),
        swapped=jnp.bool(False),
    )


def play(current, *actions, rule="interact"):
    """Play pairs of actions and return the last state and all rewards."""
    rewards = []
    for action in actions:
        current, timestep = STEP[rule](KEY, current, jnp.array(action, jnp.int32))
        rewards.append(timestep.reward.item())
    return current, rewards


def places(current):
    return [(p // 4 % 5, p // 20, p % 4) for p in current.pose.tolist()]


def cell(current, x, y):
    return current.grid[at(x, y)].item()


# Moving


def test_moves_turn_even_when_blocked():
    current, _ = play(state((1, 1, NORTH), (3, 2, NORTH)), (EAST, NORTH))
    assert places(current) == [(2, 1, EAST), (3, 1, NORTH)]
    current, _ = play(current, (NORTH, EAST))  # Pot and onions are in the way.
    assert places(current) == [(2, 1, NORTH), (3, 1, EAST)]
    current, _ = play(current, (STAY, STAY))
    assert places(current) == [(2, 1, NORTH), (3, 1, EAST)]


def test_nobody_moves_into_swaps_with_or_contests_a_cook():
    swap, _ = play(state((1, 1, NORTH), (2, 1, NORTH)), (EAST, WEST))
    assert places(swap) == [(1, 1, EAST), (2, 1, WEST)]
    contest, _ = play(state((1, 1, NORTH), (3, 1, NORTH)), (EAST, WEST))
    assert places(contest) == [(1, 1, EAST), (3, 1, WEST)]
    into, _ = play(state((1, 1, NORTH), (2, 1, SOUTH)), (EAST, STAY))
    assert places(into) == [(1, 1, EAST), (2, 1, SOUTH)]
    # They would swap places, so both stay.
    both, _ = play(state((2, 1, NORTH), (2, 2, NORTH)), (SOUTH, NORTH))
    assert places(both) == [(2, 1, SOUTH), (2, 2, NORTH)]


def test_one_cook_can_follow_the_other():
    current, _ = play(state((1, 1, NORTH), (2, 1, NORTH)), (EAST, EAST))
    assert places(current) == [(2, 1, EAST), (3, 1, EAST)]


# Using things


def test_dispensers_fill_empty_hands_only():
    current, _ = play(state((1, 1, WEST), (1, 2, SOUTH)), (INTERACT, INTERACT))
    assert current.held.tolist() == [ONION, DISH]
    current, _ = play(current, (INTERACT, INTERACT))
    assert current.held.tolist() == [ONION, DISH]


@pytest.mark.parametrize("item", [ONION, DISH, SOUP + 1, SOUP + 2, SOUP + 3])
def test_counters_take_and_give_one_thing(item):
    current = state((1, 1, NORTH), (3, 2, EAST), held=(item, NOTHING))
    current, _ = play(current, (INTERACT, INTERACT))
    assert current.held.tolist() == [NOTHING, NOTHING]
    assert cell(current, 1, 0) == COUNTER + item
    current, _ = play(current, (INTERACT, STAY))
    assert current.held.tolist() == [item, NOTHING]
    assert cell(current, 1, 0) == COUNTER
    full = state((1, 1, NORTH), (3, 2, EAST), held=(item, NOTHING), c1_0=COUNTER + DISH)
    full, _ = play(full, (INTERACT, STAY))  # There is no exchange.
    assert full.held.tolist() == [item, NOTHING]
    assert cell(full, 1, 0) == COUNTER + DISH


def test_facing_floor_or_a_cook_does_nothing():
    before = state((1, 1, EAST), (2, 1, WEST), held=(ONION, NOTHING))
    after, _ = play(before, (INTERACT, INTERACT))
    assert after.held.tolist() == [ONION, NOTHING]
    np.testing.assert_array_equal(after.grid, before.grid)


def test_player_0_is_first_at_a_counter():
    """Both cooks face the same counter, between them."""
    env = Overcooked("XPXOX\nX1X2X\nXDXSX", random_seats=False)
    start, _ = env.reset(KEY)
    facing = start._replace(pose=4 * jnp.array([6, 8]) + jnp.array([EAST, WEST]))
    act = jnp.array([INTERACT, INTERACT])
    step = jax.jit(env.step)
    after, _ = step(KEY, facing._replace(held=jnp.array([ONION, NOTHING])), act)
    assert after.held.tolist() == [NOTHING, ONION]  # Put down, then picked up at once.
    after, _ = step(KEY, facing._replace(held=jnp.array([NOTHING, ONION])), act)
    assert after.held.tolist() == [NOTHING, NOTHING]  # Nothing to take, then put down.
    after, _ = step(KEY, facing._replace(held=jnp.array([ONION, DISH])), act)
    assert after.held.tolist() == [NOTHING, DISH]
    assert after.grid[7] == COUNTER + ONION


# Pots


def at_one_pot(rule, held, pot):
    """Let both cooks use the pot (4, 2) of asymmetric_advantages.

    Returns:
        The items that they then hold, the state of the pot, and who has started it.
    """
    env = Overcooked("asymmetric_advantages", rule, random_seats=False)
    start, _ = env.reset(KEY)
    left, right = 9 * 2 + 3, 9 * 2 + 5
    facing = start._replace(
        pose=jnp.array([4 * left + EAST, 4 * right + WEST]),
        held=jnp.array(held, jnp.int32),
        grid=start.grid.at[9 * 2 + 4].set(pot),
    )
    action = jnp.array([INTERACT, INTERACT])
    after, _ = env.step(KEY, facing, action)
    starts = env.events(facing, action, after)["pot started"]
    return after.held.tolist(), after.grid[9 * 2 + 4].item(), starts.tolist()


def test_player_0_is_first_at_a_pot():
    both = at_one_pot("interact", (ONION, ONION), POT + 1)
    assert both == ([NOTHING, NOTHING], POT + 3, [0, 0])
    both = at_one_pot("interact", (ONION, ONION), POT + 2)
    assert both == ([NOTHING, ONION], POT + 3, [0, 0])
    # A pot started by player 0 takes no more onions. One filled by player 0 is started by player 1.
    started = at_one_pot("interact", (NOTHING, ONION), POT + 1)
    assert started == ([NOTHING, ONION], pot_state(1, 1), [1, 0])
    started = at_one_pot("interact", (ONION, NOTHING), POT + 1)
    assert started == ([NOTHING, NOTHING], pot_state(2, 1), [0, 1])
    started = at_one_pot("interact", (NOTHING, NOTHING), POT + 2)
    assert started == ([NOTHING, NOTHING], pot_state(2, 1), [1, 0])
    # A full pot starts by itself.
    full = at_one_pot("auto", (ONION, NOTHING), POT + 2)
    assert full == ([NOTHING, NOTHING], pot_state(3, 1), [0, 0])
    # The soup goes to player 0, and player 1 fills the empty pot.
    served = at_one_pot("auto", (DISH, DISH), pot_state(3, 20))
    assert served == ([SOUP + 3, DISH], POT, [0, 0])
    served = at_one_pot("auto", (DISH, ONION), pot_state(3, 20))
    assert served == ([SOUP + 3, NOTHING], POT + 1, [0, 0])


@pytest.mark.parametrize(("rule", "onions"), [("interact", n) for n in (1, 2, 3)] + [("auto", 3)])
def test_soup_is_ready_20_steps_after_it_was_started(rule, onions):
    """A soup started by action t cannot be taken by action t + 19, but by action t + 20."""
    if rule == "interact":
        current = state((2, 1, NORTH), (1, 2, NORTH), p2_0=POT + onions)
    else:
        current = state((2, 1, NORTH), (1, 2, NORTH), held=(ONION, NOTHING), p2_0=POT + 2)
    current, _ = play(current, (INTERACT, STAY), rule=rule)  # Action t.
    assert current.held.tolist() == [NOTHING, NOTHING]
    assert cell(current, 2, 0) == pot_state(onions, 1)
    current = current._replace(held=jnp.array([DISH, NOTHING], jnp.int32))
    current, _ = play(current, *[(INTERACT, STAY)] * 19, rule=rule)  # Actions t + 1 to t + 19.
    assert current.held.tolist() == [DISH, NOTHING]
    assert cell(current, 2, 0) == pot_state(onions, 20)
    waited, _ = play(current, *[(STAY, STAY)] * 30, rule=rule)  # Soups do not burn.
    for ready in (current, waited):
        after, _ = play(ready, (INTERACT, STAY), rule=rule)
        assert after.held.tolist() == [SOUP + onions, NOTHING]
        assert cell(after, 2, 0) == POT


def test_start_of_a_pot():
    full = state((2, 1, NORTH), (1, 2, NORTH), p2_0=POT + 3)
    waited, _ = play(full, *[(STAY, STAY)] * 5)
    assert cell(waited, 2, 0) == POT + 3
    empty, _ = play(state((2, 1, NORTH), (1, 2, NORTH)), (INTERACT, STAY))
    assert cell(empty, 2, 0) == POT
    two = state((2, 1, NORTH), (1, 2, NORTH), p2_0=POT + 2)
    assert cell(play(two, (INTERACT, STAY), rule="auto")[0], 2, 0) == POT + 2
    assert cell(play(two, (INTERACT, STAY))[0], 2, 0) == pot_state(2, 1)


@pytest.mark.parametrize(
    ("held", "pot"),
    [
        (ONION, POT + 3),
        (ONION, pot_state(1, 5)),
        (ONION, pot_state(3, 20)),
        (DISH, POT + 3),
        (DISH, pot_state(3, 18)),
        (SOUP + 3, POT),
        (NOTHING, pot_state(2, 20)),
    ],
)
def test_pots_ignore_other_items(held, pot):
    before = state((2, 1, NORTH), (1, 2, NORTH), held=(held, NOTHING), p2_0=pot)
    used, _ = play(before, (INTERACT, STAY))
    left_alone, _ = play(before, (STAY, STAY))
    assert used.held.tolist() == [held, NOTHING]
    assert cell(used, 2, 0) == cell(left_alone, 2, 0)


# Reward, time, seats


def test_only_soups_of_three_onions_are_paid():
    for item, reward in ((ONION, 0), (DISH, 0), (SOUP + 1, 0), (SOUP + 2, 0), (SOUP + 3, 20)):
        before = state((3, 2, SOUTH), (1, 1, NORTH), held=(item, NOTHING))
        after, rewards = play(before, (INTERACT, STAY))
        assert rewards == [reward]
        assert after.held.tolist() == [NOTHING if item > SOUP else item, NOTHING]
        assert after.soups == reward / 20


def test_two_deliveries_in_one_step():
    env = Overcooked("XPXPX\nO1S2D\nXDXOX", random_seats=False)
    start, _ = env.reset(KEY)
    start = start._replace(
        pose=4 * (start.pose // 4) + jnp.array([EAST, WEST]), held=jnp.full(2, SOUP + 3)
    )
    after, timestep = env.step(KEY, start, jnp.array([INTERACT, INTERACT]))
    assert timestep.reward == 40
    assert timestep.info["soups"] == 2
    assert after.held.tolist() == [NOTHING, NOTHING]


def test_time_limit_truncates():
    current = state((1, 1, NORTH), (3, 2, NORTH), time=398)
    current, timestep = STEP["interact"](KEY, current, jnp.array([STAY, STAY]))
    assert not timestep.done
    _, timestep = STEP["interact"](KEY, current, jnp.array([STAY, STAY]))
    assert timestep.truncated
    assert not timestep.terminated


def test_urgency_shows_when_fewer_than_40_steps_are_left():
    env = Overcooked(observation="lossless", random_seats=False)
    step = jax.jit(env.step)
    for time, urgent in ((359, 0), (360, 1)):  # The time after the step is 360 and 361.
        before = state((1, 1, NORTH), (3, 2, NORTH), time=time)
        _, timestep = step(KEY, before, jnp.array([STAY, STAY]))
        assert (timestep.obs.reshape(2, -1, 26)[..., 25] == urgent).all()
        assert timestep.state[-1] == jnp.float32((time + 1) / 400)


def test_start():
    current, timestep = ENVS["interact"].reset(KEY)
    assert places(current) == [(1, 2, NORTH), (3, 1, NORTH)]
    assert current.held.tolist() == [NOTHING, NOTHING]
    np.testing.assert_array_equal(current.grid, KITCHEN.grid)
    assert timestep.info == {"soups": 0}
    assert timestep.action_mask.all()
