"""Physics of micro_battle by hand arithmetic, and the ends of episodes."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_jax.micro_battle import MicroBattle, physics
from envs_jax.micro_battle.constants import unit_constants
from envs_jax.micro_battle.physics import LONG_AGO, NOBODY
from envs_jax.micro_battle.scenarios import Scenario, Spawn

NO_OP, STOP, NORTH, SOUTH, EAST, WEST, ATTACK = range(7)
NEVER = 1e9
ROOM = ((0, 0, 32, 32),)
KEY = jax.random.key(0)


@lru_cache
def program(allies, enemies, floor, balance):
    """Return a compiled step and a start, shared by all battles between such units."""
    left, bottom, *_ = floor[0]
    sides = [
        tuple(Spawn(name, left + 2.0 * i + 1, bottom + row) for i, name in enumerate(names))
        for row, names in ((1.0, allies), (3.0, enemies))
    ]
    env = MicroBattle(Scenario(*sides, floor), balance)
    return jax.jit(env.step), env.reset(KEY)[0]


def battle(allies, enemies, floor=ROOM, balance="multi"):
    """Return a compiled step, and a state with units at exact places, e.g. `[("marine", 3, 4)]`."""
    names = [tuple(unit[0] for unit in side) for side in (allies, enemies)]
    step, state = program(*names, floor, balance)
    x, y = (jnp.array([unit[axis] for unit in (*allies, *enemies)], float) for axis in (1, 2))
    return step, change(state, x=x, y=y)


def change(state, **fields):
    units = state.units
    for name, value in fields.items():
        if isinstance(value, dict):
            value = getattr(units, name).at[jnp.array(list(value))].set(list(value.values()))
        units = units._replace(**{name: value})
    return state._replace(units=units)


def play(step, state, *actions):
    timestep = None
    for number, action in enumerate(actions):
        state, timestep = step(jax.random.key(number), state, jnp.array(action))
    return state, timestep


def hits_to_kill(step, state, action, limit=400):
    """Count the attacks that begin until the only enemy, which cannot shoot, is dead."""
    hits = 0
    state = change(state, ready={-1: NEVER})
    for number in range(limit):
        state, timestep = step(jax.random.key(number), state, jnp.array(action))
        hits += int((state.units.begun[:-1] >= -8).sum())
        state = change(state, ready={-1: NEVER})
        if timestep.done:
            return hits
    raise AssertionError(f"the enemy lives after {limit} steps")


# Walking


@pytest.mark.parametrize(("unit", "reach"), [("marine", 2.25 / 2), ("stalker", 2.9531 / 2)])
def test_a_step_of_walking(unit, reach):
    step, state = battle([(unit, 10, 10)], [("marine", 30, 30)])
    start = np.array([10.0, 10.0])
    for action, direction in ((NORTH, (0, 1)), (SOUTH, (0, -1)), (EAST, (1, 0)), (WEST, (-1, 0))):
        units = play(step, state, [action])[0].units
        moved = np.array([units.x[0], units.y[0]]) - start
        np.testing.assert_allclose(moved, reach * np.array(direction), atol=1e-5)
    assert play(step, state, [STOP])[0].units.y[0] == 10


def test_walls_block_and_are_masked():
    step, state = battle([("marine", 0.5, 5)], [("marine", 30, 30)])
    after, timestep = play(step, state, [WEST])
    assert after.units.x[0] == 0.5  # The move is illegal, so the unit stays.
    assert not timestep.action_mask[0, WEST]
    assert timestep.action_mask[0, [STOP, NORTH, SOUTH, EAST]].all()


def test_units_slide_along_walls():
    # The zealot chases to the upper right, but below y = 9 the floor ends at x = 5.
    floor = ((0, 0, 5, 10), (0, 9, 10, 10))
    step, state = battle([("zealot", 4.95, 5)], [("marine", 8.4, 9.5)], floor)
    after, _ = play(step, change(state, ready={1: NEVER}), [ATTACK])
    assert 5.5 < after.units.y[0] < 6.1
    assert 4.95 <= after.units.x[0] < 5


def test_overlapping_units_part_and_buildings_stand():
    step, state = battle([("marine", 10, 10), ("marine", 10.5, 10)], [("marine", 30, 30)])
    units = play(step, state, [STOP, STOP])[0].units
    np.testing.assert_allclose(units.x[:2], [9.875, 10.625], atol=1e-4)  # 0.75 apart.
    step, state = battle([("marine", 10, 10)], [("spine_crawler", 11, 10)])
    units = play(step, change(state, ready={1: NEVER}), [STOP])[0].units
    np.testing.assert_allclose(units.x, [11 - 0.375 - 0.875, 11], atol=1e-4)


# Weapons


def test_marine_dies_of_8_hits():
    step, state = battle([("marine", 10, 10), ("marine", 10, 11)], [("marine", 15.7, 10.5)])
    assert hits_to_kill(step, state, [ATTACK, ATTACK]) in (8, 9)  # The last two may come together.
    step, state = battle([("marine", 10, 10)], [("marine", 15.7, 10)])
    assert hits_to_kill(step, state, [ATTACK]) == 8


def test_zealot_dies_of_29_hits():
    # 9 hits on 50 shields, the last of which takes 4 - 1 from health. Then 97 / 5 = 20 more.
    step, state = battle([("marine", 10, 10)], [("zealot", 15.7, 10)])
    assert hits_to_kill(step, state, [ATTACK]) == 29


@pytest.mark.parametrize(("balance", "hits"), [("liberty", 26), ("multi", 20)])
def test_spine_crawler_dies_of_hits_and_regenerates(balance, hits):
    spawns = [("stalker", 12, 10), ("stalker", 16, 10)], [("spine_crawler", 14, 15)]
    step, state = battle(*spawns, balance=balance)
    assert hits_to_kill(step, state, [ATTACK, ATTACK]) == hits


def test_shots_are_a_period_and_a_random_delay_apart():
    step, state = battle([("marine", 10, 10)], [("marine", 15, 10)])
    begun, time = [], 0
    for number in range(200):
        state = change(state, ready={1: NEVER}, health={1: 45.0})
        state, _ = step(jax.random.key(number), state, jnp.array([ATTACK]))
        time += 8
        if state.units.begun[0] >= -8:
            begun.append(time + float(state.units.begun[0]))
    apart = np.diff(begun)
    # 0.8608 s = 13.77 ticks, plus U(-1, 2), rounded up to whole ticks: 13 to 16, 14.77 on average.
    assert set(apart) == {13, 14, 15, 16}
    assert abs(apart.mean() - 14.77) < 3 * 0.9 / np.sqrt(len(apart))


def test_zealot_hits_twice():
    step, state = battle([("zealot", 10, 10)], [("marine", 10.9, 10)])
    state = change(state, ready={0: 1.0, 1: NEVER}, begun={1: 0.0})
    after, _ = play(step, state, [ATTACK])
    # The hits are at ticks 1 and 1 + 4.48, rounded up. Both are within the step and take 8 each.
    assert after.units.health[1] == 45 - 16
    state = change(state, ready={0: 5.0})
    middle, _ = play(step, state, [ATTACK])
    assert middle.units.health[1] == 45 - 8
    # The second hit lands even if the order changes and the marine is out of reach by then.
    away = change(middle, x={1: 14.0}, ready={1: NEVER})
    assert play(step, away, [WEST])[0].units.health[1] == 45 - 16


def test_spine_crawler_winds_up_and_misses_a_target_that_leaves():
    step, state = battle([("stalker", 10, 10)], [("spine_crawler", 18.3, 10)])
    hit, _ = play(step, state, [STOP])
    assert hit.units.shield[0] == 80 - 30  # 0.3332 s are 6 ticks.
    # At 8.45 of 8.5 cells, one tick of walking is enough to leave the range.
    state = change(state, x={0: 18.3 - 8.45})
    missed, _ = play(step, state, [WEST])
    assert missed.units.shield[0] == 80
    assert missed.units.ready[1] == 0
    assert missed.units.target[1] == NOBODY


def constants_of(*units):
    scenario = Scenario((Spawn(units[0], 5.0, 5.0),), (Spawn(units[1], 9.0, 5.0),), ROOM)
    return unit_constants(scenario, "multi")


@pytest.mark.parametrize(
    ("victim", "shooter", "health", "shield", "expected"),
    [
        ("stalker", "spine_crawler", 80, 80, (80, 50)),  # 25 + 5, armored.
        ("stalker", "spine_crawler", 80, 20, (80 - 9, 0)),  # 20 on shields, 10 - 1 on health.
        ("stalker", "spine_crawler", 80, 0, (80 - 29, 0)),
        ("zealot", "marine", 100, 2, (100 - 3, 0)),
        ("zealot", "marine", 100, 5.9, (100 - 0.5, 0)),  # A hit takes at least 0.5.
        ("marine", "stalker", 45, 0, (45 - 13, 0)),
    ],
)
def test_a_hit(victim, shooter, health, shield, expected):
    constants = constants_of(victim, shooter)
    state = battle([(victim, 5, 5)], [(shooter, 9, 5)])[1]
    fields = {"health": {0: health}, "shield": {0: shield}, "target": {1: 0}}
    units = change(state, **fields).units
    after = physics.take_hits(constants, units, jnp.array([False, True]), jnp.float32(3))
    np.testing.assert_allclose((after.health[0], after.shield[0]), expected, atol=1e-5)
    assert (after.shooter[0], after.struck[0]) == (1, 3)
    assert after.shooter[1] == NOBODY


def test_regeneration():
    step, state = battle([("stalker", 10, 10)], [("spine_crawler", 30, 30)])
    state = change(state, shield={0: 0.0}, health={0: 50.0, 1: 100.0})
    rested, _ = play(step, change(state, struck={0: -160.0}), [STOP])
    np.testing.assert_allclose(rested.units.shield[0], 1.0, atol=1e-5)
    too_early, _ = play(step, change(state, struck={0: -150.0}), [STOP])
    assert too_early.units.shield[0] == 0
    np.testing.assert_allclose(rested.units.health, [50, 100 + 0.2734 / 2], atol=1e-4)
    full, _ = play(step, change(state, shield={0: 79.9}, struck={0: LONG_AGO}), [STOP])
    assert full.units.shield[0] == 80


# Enemies


@pytest.mark.parametrize(
    ("places", "fields", "expected"),
    [
        ([(10, 10), (14, 10)], {}, 1),  # The nearer one.
        ([(10, 10), (14, 10)], {"target": {2: 0}}, 1),  # The old target is out of reach.
        ([(14.5, 10), (14.9, 10)], {"target": {2: 0}}, 0),  # The old target is in reach.
        ([(10, 10), (13, 10)], {"shooter": {2: 0}, "struck": {2: -16.0}}, 0),  # The shooter.
        ([(10, 10), (13, 10)], {"shooter": {2: 0}, "struck": {2: -17.0}}, 1),  # Too long ago.
        ([(5, 10), (13, 10)], {"shooter": {2: 0}, "struck": {2: 0.0}}, 1),  # Too far away.
        ([(14.5, 10), (13, 10)], {"health": {0: 0.0}}, 1),  # The other one is dead.
        ([(5, 10), (6, 10)], {}, NOBODY),  # Both are beyond 5 + 0.5 + 0.375.
    ],
)
def test_target_of_a_zealot(places, fields, expected):
    spawns = [("marine", *place) for place in places], [("zealot", 15.4, 10)]
    state = change(battle(*spawns)[1], **fields)
    constants = unit_constants(
        Scenario(*(tuple(Spawn(*unit) for unit in side) for side in spawns), ROOM), "multi"
    )
    units = state.units
    away = physics.length(units.x - units.x[:, None], units.y - units.y[:, None])
    no_orders = physics.Orders(jnp.full(3, NOBODY), jnp.zeros(3), jnp.zeros(3))
    target = physics.choose_targets(constants, units, away, no_orders, jnp.float32(0))
    assert target.tolist() == [NOBODY, NOBODY, expected]


def test_enemies_walk_to_their_goal_and_stay():
    spawns = (Spawn("marine", 2.0, 2.0),), (Spawn("marine", 20.0, 20.0),)
    env = MicroBattle(Scenario(*spawns, ROOM, ((20.0, 25.0),)))
    step, state = jax.jit(env.step), env.reset(KEY)[0]
    state, _ = play(step, state, *[[STOP]] * 10)
    assert np.hypot(state.units.x[1] - 20, state.units.y[1] - 25) <= 0.3
    again, _ = play(step, state, [STOP])
    assert (again.units.x[1], again.units.y[1]) == (state.units.x[1], state.units.y[1])


def test_allies_without_orders_do_nothing():
    step, state = battle([("marine", 10, 10)], [("marine", 14, 10)])
    after, _ = play(step, change(state, ready={1: NEVER}), [STOP], [STOP], [STOP])
    assert after.units.health[1] == 45
    assert after.units.begun[0] < -100


# Ends


def test_victory_is_paid_once():
    step, state = battle([("marine", 10, 10)], [("marine", 15, 10)])
    state = change(state, health={1: 6.0}, ready={1: NEVER})
    after, timestep = play(step, state, [ATTACK])
    assert (timestep.reward, timestep.terminated, timestep.truncated) == (1, True, False)
    assert timestep.info["success"] == 1
    assert play(step, after, [STOP])[1].reward == 0


def test_a_draw_ends_the_episode_and_pays_nothing():
    step, state = battle([("marine", 10, 10)], [("marine", 15, 10)])
    state = change(state, health={0: 6.0, 1: 6.0})
    after, timestep = play(step, state, [ATTACK])
    assert (after.units.health <= 0).all()
    assert (timestep.reward, timestep.terminated, timestep.info["success"]) == (0, True, 0)


def test_defeat_and_the_time_limit():
    step, state = battle([("marine", 10, 10)], [("marine", 15, 10)])
    _, timestep = play(step, change(state, health={0: 6.0}), [STOP])
    assert (timestep.reward, timestep.terminated, timestep.truncated) == (0, True, False)
    assert timestep.action_mask.tolist() == [[True] + [False] * 6]
    step, state = battle([("marine", 10, 10)], [("marine", 30, 30)])
    state = state._replace(time=jnp.int32(98))
    _, before = play(step, state, [STOP])
    _, last = play(step, state, [STOP], [STOP])
    assert not before.done
    assert (last.terminated, last.truncated, last.reward) == (False, True, 0)


def test_batched_copies_step_as_single_ones():
    env, keys = MicroBattle("2m_vs_1z"), jax.random.split(KEY, 3)
    states, _ = jax.vmap(env.reset)(keys)
    action = jnp.array([ATTACK, EAST])
    _, together = jax.jit(jax.vmap(env.step, in_axes=(0, 0, None)))(keys, states, action)
    assert len(np.unique(together.state, axis=0)) == 3
    for i, key in enumerate(keys):
        _, alone = jax.jit(env.step)(key, jax.tree.map(lambda x, i=i: x[i], states), action)
        np.testing.assert_allclose(together.state[i], alone.state, atol=1e-6)
