"""Observations and masks of micro_battle by hand, starts, and invalid scenarios."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from envs_jax.micro_battle.environment import MicroBattle
from envs_jax.micro_battle.observations import action_mask
from envs_jax.micro_battle.scenarios import SCENARIOS, Scenario, Spawn

ONE_HOT = np.eye(7).tolist()


@pytest.mark.parametrize(
    ("scenario", "mappo", "smac", "actions", "limit"),
    [
        ("3m", (64, 75), (30, 48), 9, 60),
        ("2s_vs_1sc", (37, 34), (17, 27), 7, 300),
        ("2m_vs_1z", (36, 33), (16, 26), 7, 150),
        ("5m_vs_6m", (124, 170), (55, 98), 12, 70),
        ("2s3z", (144, 175), (80, 120), 11, 120),  # Unit types are told apart here.
        ("3s_vs_5z", (88, 123), (48, 68), 11, 250),
    ],
)
def test_sizes_are_smacs(scenario, mappo, smac, actions, limit):
    for observation, state, sizes in (
        ("mappo", None, mappo),  # The state has the format of the observations.
        ("smac", None, smac),
        ("mappo", "smac", (mappo[0], smac[1])),  # As HMASD's authors.
        ("smac", "mappo", (smac[0], mappo[1])),
    ):
        env = MicroBattle(scenario, observation=observation, state=state)
        assert (env.obs_dim, env.state_dim) == sizes
        assert (env.num_actions, env.max_steps) == (actions, limit)
        at_reset = jax.eval_shape(env.reset, jax.random.key(0))[1]
        assert at_reset.obs.shape == (env.num_agents, sizes[0])
        assert at_reset.state.shape == (sizes[1],)


def seen(observation, state=None, **fields):
    """Return a time step with two marines and a zealot at (10, 10), (14, 13) and (13, 14).

    Both other units are 5 cells away from the first marine.
    """
    env = MicroBattle("2m_vs_1z", observation=observation, state=state)
    env_state, _ = env.reset(jax.random.key(0))
    values = {
        "x": [10, 14, 13], "y": [10, 13, 14], "health": [30, 45, 50],
        "shield": [0, 0, 25], "ready": [9, 0, 7], **fields,
    }  # fmt: skip
    values = {k: jnp.array(v, jnp.float32) for k, v in values.items()}
    env_state = env_state._replace(
        units=env_state.units._replace(**values), last_action=jnp.array([6, 1])
    )
    return env._timestep(env_state, jnp.bool(False))


def test_format_of_the_wrapper_by_hand():
    timestep = seen("mappo")
    near = np.sqrt(2) / 9
    first = [1, 5 / 9, 4 / 9, 3 / 9, 1, *ONE_HOT[1]]  # The other marine.
    first += [1, 5 / 9, 3 / 9, 4 / 9, 0.5, 0.5]  # The zealot.
    first += [1, 1, 1, 1, 1, 0, 0, 0, 2 / 3, *ONE_HOT[6], 1, 0]  # Moves, itself, index.
    second = [1, 5 / 9, -4 / 9, -3 / 9, 2 / 3, *ONE_HOT[6]]
    second += [1, near, -1 / 9, 1 / 9, 0.5, 0.5]
    second += [1, 1, 1, 1, 1, 0, 0, 0, 1, *ONE_HOT[1], 0, 1]
    np.testing.assert_allclose(timestep.obs, [first, second], atol=1e-6)
    state = [2 / 3, 9 / 15, -6 / 32, -6 / 32, *ONE_HOT[6]]  # Health, cooldown, x, y, last action.
    state += [1, 0, -2 / 32, -3 / 32, *ONE_HOT[1]]
    state += [0.5, -3 / 32, -2 / 32, 0.5, *[0] * 7]  # Health, x, y, shield, zeros.
    np.testing.assert_allclose(timestep.state, state, atol=1e-6)


def test_format_of_smac_by_hand():
    timestep = seen("smac")
    first = [1, 1, 1, 1, 1, 5 / 9, 3 / 9, 4 / 9, 0.5, 0.5, 1, 5 / 9, 4 / 9, 3 / 9, 1, 2 / 3]
    np.testing.assert_allclose(timestep.obs[0], first, atol=1e-6)
    state = [2 / 3, 9 / 15, -6 / 32, -6 / 32, 1, 0, -2 / 32, -3 / 32]
    state += [0.5, -3 / 32, -2 / 32, 0.5, *ONE_HOT[6], *ONE_HOT[1]]
    np.testing.assert_allclose(timestep.state, state, atol=1e-6)


def test_each_half_of_a_mixed_format_is_that_of_the_pure_format():
    mappo, smac, mixed = seen("mappo"), seen("smac"), seen("mappo", "smac")
    np.testing.assert_array_equal(mixed.obs, mappo.obs)
    np.testing.assert_array_equal(mixed.state, smac.state)


def test_the_dead_see_nothing_and_are_not_seen():
    timestep = seen("mappo", health=[0, 45, 50])
    np.testing.assert_array_equal(timestep.obs[0], [0] * 34 + [1, 0])
    np.testing.assert_array_equal(timestep.obs[1, :12], np.zeros(12))
    np.testing.assert_array_equal(timestep.state[:11], np.zeros(11))
    assert timestep.action_mask[0].tolist() == [True] + [False] * 6
    assert timestep.info["allies_alive"] == 1
    timestep = seen("smac", health=[0, 45, 50])
    assert not timestep.obs[0].any()


def test_beyond_9_cells_nothing_is_seen():
    timestep = seen("smac", x=[8.0, 17.5, 17.0], y=[14.0, 14.0, 14.0])  # 9.5 and 9 apart.
    np.testing.assert_array_equal(timestep.obs[0, 4:15], np.zeros(11))


def test_masks():
    mask = seen("smac", x=[6.5, 12, 18.0], y=[14.0] * 3).action_mask
    # The living have no no-op but always stop. (5.5, 14) is a wall. The zealot is 11.5 cells away
    # from one marine and exactly 6 from the other.
    assert mask[0].tolist() == [False, True, True, True, True, False, False]
    assert mask[1].tolist() == [False, True, True, True, True, True, True]
    assert not seen("smac", x=[6.5, 11.99, 18.0], y=[14.0] * 3).action_mask[1, 6]
    # In 2s_vs_1sc the floor of row 21 goes from x = 10 to 17, and above x = 10 is a wall.
    env = MicroBattle("2s_vs_1sc")
    units = env.reset(jax.random.key(0))[0].units
    units = units._replace(x=jnp.array([10.5, 11.5, 14.0]), y=jnp.array([21.5, 21.5, 20.0]))
    north, west = action_mask(env.resolved_scenario, units)[:2, [2, 5]].T.tolist()
    assert (north, west) == ([False, True], [False, True])


def test_starts_are_those_of_the_map_with_jitter():
    env = MicroBattle("2m_vs_1z")
    state, timestep = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 500))
    off = np.stack([state.units.x - np.array([13, 19, 16]), state.units.y - np.array([12, 12, 19])])
    # Starts are uniform over a disc of radius 0.1, so coordinates have a deviation of 0.05.
    assert 0.099 < np.hypot(*off).max() <= 0.1 + 1e-5
    assert abs(off.mean((1, 2))).max() < 0.005
    np.testing.assert_allclose(off.std((1, 2)), 0.05, atol=0.002)
    assert (state.goal[:, 1] == 12).all()
    assert 13 <= state.goal[:, 0].min() < 13.1 < 18.9 < state.goal[:, 0].max() <= 19
    assert not timestep.done.any()
    spine = jax.vmap(MicroBattle("2s_vs_1sc").reset)(jax.random.split(jax.random.key(0), 9))[0]
    assert (spine.units.x[:, 2] == 14).all()


@pytest.mark.parametrize("jitter", [0.0, 0.05])
def test_jitter_is_a_setting_of_the_scenario(jitter):
    scenario = dataclasses.replace(SCENARIOS["2m_vs_1z"], jitter=jitter)
    keys = jax.random.split(jax.random.key(0), 100)
    usual, changed = (jax.vmap(MicroBattle(name).reset)(keys)[0] for name in ("2m_vs_1z", scenario))
    for axis, places in (("x", np.array([13, 19, 16])), ("y", np.array([12, 12, 19]))):
        offset = np.asarray(getattr(usual.units, axis)) - places
        expected = places + jitter / 0.1 * offset
        np.testing.assert_allclose(getattr(changed.units, axis), expected, atol=1e-5)


SMALL = Scenario((Spawn("marine", 2.0, 2.0),), (Spawn("zealot", 6.0, 6.0),), ((0, 0, 8, 8),))


OFF_MAP = "floor must be rectangles (left, bottom, right, top) that are not empty, on a map of"


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"allies": ()}, "allies must have at least one unit, got none"),
        ({"enemies": ()}, "enemies must have at least one unit, got none"),
        (
            {"allies": (Spawn("marin", 2.0, 2.0),)},
            "allies[0]: unit 'marin' is unknown (did you mean marine?)",
        ),
        (
            {"allies": (Spawn("spine_crawler", 2.0, 2.0),)},
            "allies[0]: a spine_crawler cannot move; choose a unit that can for an agent",
        ),
        (
            {"enemies": (Spawn("zealot", 8.5, 6.0),)},
            "enemies[0]: the zealot at (8.5, 6.0) starts in a wall, or less than 0.1 from one; "
            "move it onto the floor",
        ),
        ({"enemies": (Spawn("zealot", 2.0, 2.0),)}, "allies[0]: another unit also starts at"),
        ({"size": ()}, "size must be width and height, got ()"),
        ({"size": (0, 0)}, "size must be at least 1, got 0"),
        ({"size": (-5, -5)}, "size must be at least 1, got -5"),
        (
            {"size": (4, 4)},
            OFF_MAP,
        ),
        (
            {"floor": ((0, 0, 2**40, 8),)},
            OFF_MAP,
        ),
        ({"max_steps": 2**31}, "max_steps must be at most 2147483647"),
        ({"floor": ()}, "floor must be rectangles (left, bottom, right, top) that are not empty"),
        ({"floor": ((4, 0, 4, 8),)}, "floor must be rectangles (left, bottom, right, top) that"),
        ({"goals": ((9.0, 1.0),)}, "goals: (9.0, 1.0) is in a wall; move it onto the floor"),
        ({"goals": ((1.0, 1.0),) * 3}, "goals must hold no, one or two points, got 3"),
        ({"max_steps": 0}, "max_steps must be at least 1, got 0"),
        ({"jitter": -0.1}, "jitter must be finite and at least 0, got -0.1"),
        ({"jitter": float("nan")}, "jitter must be finite and at least 0, got nan"),
        ({"jitter": 3.0}, "allies[0]: the marine at (2.0, 2.0) starts in a wall, or less than 3.0"),
    ],
)
def test_invalid_scenarios_are_refused(fields, message):
    with pytest.raises(ValueError) as error:  # noqa: PT011 (the message is compared)
        dataclasses.replace(SMALL, **fields)
    assert str(error.value).startswith(message)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"scenario": "3n"},
            "scenario '3n' is unknown (known: 3m, 2s_vs_1sc",
        ),
        ({"balance": "wol"}, "balance must be multi or liberty, got 'wol'"),
        ({"observation": "raw"}, "observation must be mappo or smac, got 'raw'"),
        ({"state": "raw"}, "state must be mappo or smac, got 'raw'"),
        ({"time_limit": 0}, "time_limit must be at least 1, got 0"),
    ],
)
def test_invalid_settings_are_refused(fields, message):
    with pytest.raises(ValueError) as error:  # noqa: PT011 (the message is compared)
        MicroBattle(**fields)
    assert str(error.value).startswith(message)


@pytest.mark.parametrize(
    "scenario", ["2s_vs_1sc", "2m_vs_1z", SMALL], ids=lambda s: s if isinstance(s, str) else "own"
)
def test_scenarios_pass_the_check(scenario):
    envs_jax.check_environment(MicroBattle(scenario, "liberty", "mappo", "smac", time_limit=40))


@pytest.mark.parametrize("name", sorted(SCENARIOS))
def test_frames_show_the_living(name):
    env = MicroBattle(name)
    state, _ = jax.jit(env.reset)(jax.random.key(0))

    def has(frame, color):
        return (frame == np.array(color)).all(-1).any()

    frame = env.render(state)
    assert all(has(frame, color) for color in (*env.agent_colors, (196, 58, 58)))
    units = state.units._replace(health=state.units.health.at[0].set(0))
    assert not has(env.render(state._replace(units=units)), env.agent_colors[0])
