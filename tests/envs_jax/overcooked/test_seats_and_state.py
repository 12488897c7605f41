"""Seats of the cooks, and the global state in the frame of the kitchen."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_jax.overcooked.environment import Overcooked
from envs_jax.overcooked.rules import DISH, IDLE, ONION, READY, SOUP, pot_state, read_pot

NORTH, SOUTH, EAST, WEST, STAY, INTERACT = range(6)
KEY = jax.random.key(0)


@pytest.mark.parametrize(
    ("observation", "state", "agents_end"),
    [("features", "obs", [96, 192]), ("lossless", "obs", [0, 0]), ("features", "kitchen", [0, 0])],
)
def test_swapped_seats_permute_agents_and_nothing_else(observation, state, agents_end):
    """`agents_end`: where the numbers of agent 0 and of agent 1 end in the state."""
    env = Overcooked("asymmetric_advantages", observation=observation, state=state)
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    starts = [reset(jax.random.key(seed)) for seed in range(8)]
    (plain, seen), (swapped, seen_swapped) = (
        next(start for start in starts if start[0].swapped == side) for side in (False, True)
    )
    for actions in ((EAST, SOUTH), (WEST, INTERACT), (INTERACT, NORTH), (INTERACT, INTERACT)):
        np.testing.assert_array_equal(seen.obs, seen_swapped.obs[::-1])
        first, second, rest = np.split(seen.state, agents_end)
        expected = np.r_[second, first, rest]
        if state == "kitchen":  # Its last number tells who sits where.
            assert expected[-1] == 0
            expected[-1] = 1
        np.testing.assert_array_equal(expected, seen_swapped.state)
        plain, seen = step(KEY, plain, jnp.array(actions))
        swapped, seen_swapped = step(KEY, swapped, jnp.array(actions[::-1]))
    for name in ("pose", "held", "grid"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(swapped, name))


@pytest.mark.parametrize("layout", ["cramped_room", "asymmetric_advantages", "coordination_ring"])
def test_the_state_of_the_kitchen_names_every_cook_and_pot(layout):
    env = Overcooked(layout, state="kitchen")
    kitchen = env.kitchen
    assert env.state_dim == 19 + 5 * len(kitchen.pots)
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    current, timestep = reset(KEY)
    rng, seen = np.random.default_rng(0), set()
    for i in range(400):
        if i % 20 == 0:  # Soups are rare in random play.
            pot = kitchen.pots[i // 20 % len(kitchen.pots)]
            filled = pot_state(1 + i // 20 % 3, rng.integers(IDLE, READY + 1))
            grid = current.grid.at[pot].set(filled)
            current = current._replace(grid=grid, held=jnp.array(rng.integers(0, 6, 2)))
        current, timestep = step(KEY, current, jnp.array(rng.integers(0, 6, 2)))
        assert timestep.state.shape == (env.state_dim,)
        expected = []
        for pose, item in zip(np.asarray(current.pose), np.asarray(current.held), strict=True):
            turn = np.arange(4) == pose % 4
            hand = [item == ONION, item == DISH, item > SOUP]
            expected += [*turn, *hand, *kitchen.xy(int(pose) // 4)]
            seen.add(int(item))
        for pot in kitchen.pots:
            onions, cooked = read_pot(int(current.grid[pot]))
            flags = [onions == 3, 0 <= cooked < 20, cooked == 20]
            expected += [onions, *flags, 20 - cooked if 0 <= cooked < 20 else 0]
            seen.add(("pot", int(pot), flags.index(True) if any(flags) else None))
        expected.append(current.swapped)
        np.testing.assert_array_equal(timestep.state, np.array(expected, np.float32))
    assert set(range(6)) <= seen
    assert {("pot", int(pot), flag) for pot in kitchen.pots for flag in (0, 1, 2)} <= seen


def test_seats_are_a_fair_coin_or_fixed():
    keys = jax.random.split(jax.random.key(0), 10_000)
    swapped = jax.jit(jax.vmap(lambda key: Overcooked().reset(key)[0].swapped))(keys)
    assert abs(swapped.mean() - 0.5) < 4 * 0.5 / 100  # Four standard errors.
    fixed = Overcooked(random_seats=False)
    assert not any(fixed.reset(key)[0].swapped for key in keys[:5])
