"""Kitchens of Overcooked: the five layouts, own and invalid ones, and pictures."""

import numpy as np
import pytest

from envs_jax.overcooked.environment import Overcooked
from envs_jax.overcooked.layouts import LAYOUTS, read
from envs_jax.overcooked.rules import (
    COUNTER,
    DISH,
    DISHES,
    FLOOR,
    IDLE,
    NUM_CELL_STATES,
    ONION,
    ONIONS,
    POT,
    READY,
    SERVING,
    SOUP,
    pot_state,
    read_pot,
)

OWN = """
    XXPXX
    O1 2D
    XXSXX
"""


@pytest.mark.parametrize(
    ("layout", "size", "floor", "start", "pots", "onions", "dishes", "serving", "counters"),
    [
        (
            *("cramped_room", (5, 4), 6, [(1, 2), (3, 1)], [(2, 0)]),
            *([(0, 1), (4, 1)], [(1, 3)], [(3, 3)], 9),
        ),
        (
            *("asymmetric_advantages", (9, 5), 14, [(6, 2), (1, 3)], [(4, 2), (4, 3)]),
            *([(0, 1), (5, 1)], [(3, 4), (5, 4)], [(3, 1), (8, 1)], 23),
        ),
        (
            *("coordination_ring", (5, 5), 8, [(2, 1), (1, 2)], [(3, 0), (4, 1)]),
            *([(0, 3), (1, 4)], [(0, 2)], [(2, 4)], 11),
        ),
        (
            *("forced_coordination", (5, 5), 6, [(3, 1), (1, 2)], [(3, 0), (4, 1)]),
            *([(0, 1), (0, 2)], [(0, 3)], [(3, 4)], 13),
        ),
        (
            *("counter_circuit_o_1order", (8, 5), 14, [(3, 3), (3, 1)], [(3, 0), (4, 0)]),
            *([(3, 4), (4, 4)], [(0, 2)], [(7, 2)], 20),
        ),
    ],
)
def test_geometry_of_the_classic_layouts(
    layout, size, floor, start, pots, onions, dishes, serving, counters
):
    kitchen = read(layout)
    assert (kitchen.width, kitchen.height) == size

    def cells(state):
        return [tuple(kitchen.xy(cell).tolist()) for cell in np.flatnonzero(kitchen.grid == state)]

    assert len(cells(FLOOR)) == floor
    assert [tuple(kitchen.xy(cell).tolist()) for cell in kitchen.start] == start
    assert [cells(kind) for kind in (POT, ONIONS, DISHES, SERVING)] == [
        *(pots, onions, dishes, serving),
    ]
    assert len(cells(COUNTER)) == counters
    lossless = Overcooked(layout, observation="lossless")
    cells_26 = 26 * size[0] * size[1]
    assert (lossless.obs_dim, lossless.state_dim) == (cells_26, cells_26 + 1)
    assert (Overcooked(layout).obs_dim, Overcooked(layout).state_dim) == (96, 192)


def test_states_of_pots_are_numbered_without_gaps():
    states = [pot_state(n, IDLE) for n in range(4)]
    states += [pot_state(n, t) for t in range(READY + 1) for n in (1, 2, 3)]
    assert states == list(range(POT, NUM_CELL_STATES))
    assert [pot_state(*read_pot(state)) for state in states] == states


def test_own_kitchen():
    kitchen = Overcooked(OWN).kitchen
    assert (kitchen.width, kitchen.height) == (5, 3)
    assert kitchen.start.tolist() == [6, 8]
    assert kitchen.pots.tolist() == [2]
    assert (
        Overcooked(OWN.strip().replace("    ", "")).kitchen.grid.tolist() == kitchen.grid.tolist()
    )


@pytest.mark.parametrize(
    ("layout", "message"),
    [
        ("cramped_rom", "layout 'cramped_rom' is unknown (did you mean cramped_room?)"),
        ("kitchen", "layout 'kitchen' is unknown (known: cramped_room, "),
        ("XXPXX\nO1T2D\nXXSXX", "layout: unknown letter 'T' in row 2; a cell is X counter, "),
        ("X" * 129 + "\nX", "layout: 2 x 129 cells; a side has at most 128"),
        ("XXPXX\nO1 2\nXXSXX", "layout: row 2 has 4 cells, row 1 has 5; make all rows equally"),
        ("XXPXX\nO1  D\nXXSXX", "layout: '2' occurs 0 times; write exactly one 1 and one 2 for"),
        ("XXPXX\nO121D\nXXSXX", "layout: '1' occurs 2 times; write exactly one 1 and one 2 for"),
        ("XXXXX\nO1 2D\nXXSXX", "layout: no pot on the map; write at least one P"),
        ("XXPXX\nX1 2D\nXXSXX", "layout: no onions on the map; write at least one O"),
        ("XXPXX\nO1 2X\nXXSXX", "layout: no dishes on the map; write at least one D"),
        ("XXPXX\nO1 2D\nXXXXX", "layout: no serving window on the map; write at least one S"),
        (
            "XXP X\nO1 2D\nXXSXX",
            "layout: the border has a floor cell; close it, ",
        ),
        (
            "XXPXX\nO1 X2\nXXSXD",
            "layout: the border has a floor cell; close it, ",
        ),
        # Walled in: one player, and the other has no dishes.
        ("XXXXPXX\nX1XO2 S\nXXXXXXX\nDXXXXXX", "layout: the players cannot serve a soup; open"),
        # Onions and pot belong to different players, who share no counter.
        ("XOXXXPX\nX1XX2DX\nXXXXXSX", "layout: the players cannot bring onions to a pot; open"),
        # Both can face the pot, but only the one without dishes faces the window.
        ("XOXDX\nS1P2X\nXXXXX", "layout: the players cannot serve a soup; open a way, or give"),
        ("X" * 10_000, "layout 'XXX"),
    ],
)
def test_invalid_kitchens_are_refused(layout, message):
    with pytest.raises(ValueError) as error:  # noqa: PT011 (the whole message is compared)
        Overcooked(layout)
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


def test_players_may_pass_things_over_a_counter_or_a_pot():
    read("XOXPX\nX1X2S\nXXXDX")  # The onions go over the counter between them.
    read("XOXDX\nX1P2S\nXXXXX")  # One fills the pot and the other empties it.


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("layout", [9.0], "layout must be a name or lines of text, got [9.0]"),
        ("max_steps", 0, "max_steps must be at least 1, got 0"),
        (
            "start_cooking",
            "never",
            "start_cooking must be interact or auto, got 'never'",
        ),
        ("observation", "raw", "observation must be features or lossless, got 'raw'"),
    ],
)
def test_invalid_settings_are_refused(field, value, message):
    with pytest.raises(ValueError) as error:  # noqa: PT011 (the whole message is compared)
        Overcooked(**{field: value})
    assert str(error.value) == message


def test_pictures_show_what_changes():
    """Check that cell states, held items, orientations and seats all look different."""
    env = Overcooked(random_seats=False)
    start, _ = env.reset(None)
    start = start._replace(**{name: np.array(getattr(start, name)) for name in ("grid", "held")})
    picture = env.render(start)
    assert picture.shape == (4 * 64, 5 * 64, 3)
    seen = {picture.tobytes()}
    states = [(1, COUNTER + ONION), (1, COUNTER + DISH), (1, COUNTER + SOUP + 3)]
    states += [(2, pot_state(n, t)) for n in (1, 2, 3) for t in (IDLE, 1, 10, READY)]
    for cell, code in states:
        grid = start.grid.copy()
        grid[cell] = code
        seen.add(env.render(start._replace(grid=grid)).tobytes())
    for item in range(1, 6):
        seen.add(env.render(start._replace(held=np.array([item, 0]))).tobytes())
    for orientation in range(1, 4):
        seen.add(env.render(start._replace(pose=start.pose + np.array([orientation, 0]))).tobytes())
    seen.add(env.render(start._replace(swapped=np.array(True))).tobytes())
    assert len(seen) == 1 + len(states) + 5 + 3 + 1
    assert {tuple(color) for color in env.agent_colors} < {
        tuple(pixel) for pixel in picture.reshape(-1, 3).tolist()
    }


def test_all_layouts_are_drawn():
    for layout in LAYOUTS:
        env = Overcooked(layout, random_seats=False)
        kitchen = env.kitchen
        assert env.render(env.reset(None)[0]).shape == (64 * kitchen.height, 64 * kitchen.width, 3)
