"""Rules of Alice_and_Bob one by one, its two encodings, and the odds of random play."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs_jax.alice_and_bob import AliceAndBob, AliceAndBobState

RIGHT, LEFT, UP, DOWN, STAY = range(5)
RED_BUTTON, BLUE_BUTTON = (1, 8), (1, 1)
RED_DIAMOND, BLUE_DIAMOND = (8, 1), (8, 8)

CODES = AliceAndBob()
ONE_HOT = AliceAndBob(observation="one_hot")
KEY = jax.random.key(0)
step_codes = jax.jit(CODES.step)
observe_codes = jax.jit(lambda s: CODES._timestep(s, jnp.float32(0)))
observe_one_hot = jax.jit(lambda s: ONE_HOT._timestep(s, jnp.float32(0)))


def at(alice, bob, collected=(False, False), time=0):
    return AliceAndBobState(jnp.array([alice, bob]), jnp.array(collected), jnp.int32(time))


def play(state, *actions):
    """Play pairs of actions and return the last state and all time steps."""
    timesteps = []
    for action in actions:
        state, timestep = step_codes(KEY, state, jnp.array(action))
        timesteps.append(timestep)
    return state, timesteps


def cells(state):
    return [tuple(cell) for cell in np.asarray(state.position).tolist()]


# Rules


def test_actions_move_and_walls_block():
    state, _ = play(at((4, 4), (5, 5)), (RIGHT, LEFT))
    assert cells(state) == [(4, 5), (5, 4)]
    state, _ = play(state, (UP, DOWN))
    assert cells(state) == [(3, 5), (6, 4)]
    state, _ = play(state, (STAY, STAY))
    assert cells(state) == [(3, 5), (6, 4)]
    for corner, blocked in [
        ((1, 1), (UP, LEFT)),
        ((1, 8), (UP, RIGHT)),
        ((8, 1), (DOWN, LEFT)),
        ((8, 8), (DOWN, RIGHT)),
    ]:
        for action in blocked:
            assert cells(play(at(corner, corner), (action, action))[0]) == [corner, corner]


def test_agents_share_and_swap_cells():
    state, _ = play(at((4, 4), (4, 5)), (RIGHT, STAY))
    assert cells(state) == [(4, 5), (4, 5)]
    state, _ = play(at((4, 4), (4, 5)), (RIGHT, LEFT))
    assert cells(state) == [(4, 5), (4, 4)]


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize(
    ("button", "diamond", "expected"),
    [
        (RED_BUTTON, RED_DIAMOND, [True, False]),
        (BLUE_BUTTON, BLUE_DIAMOND, [False, True]),
        (RED_BUTTON, BLUE_DIAMOND, [False, False]),
        (BLUE_BUTTON, RED_DIAMOND, [False, False]),
        (RED_BUTTON, (7, 1), [False, False]),  # Nobody on the diamond.
        ((2, 8), RED_DIAMOND, [False, False]),  # Nobody on the button.
    ],
)
def test_diamond_needs_its_button_in_the_same_step(button, diamond, expected, swap):
    places = (diamond, button) if swap else (button, diamond)
    state, timesteps = play(at(*places), (STAY, STAY))
    assert state.collected.tolist() == expected
    assert timesteps[0].info["diamonds"] == sum(expected)
    assert timesteps[0].reward == 0
    assert not timesteps[0].done


def test_nothing_is_collected_before_the_first_step():
    assert not ONE_HOT.reset(KEY)[0].collected.any()
    # Standing on both at the start and walking off at once collects nothing.
    state, _ = play(at(RED_BUTTON, RED_DIAMOND), (LEFT, STAY))
    assert not state.collected.any()
    # Pressing now and being on the diamond one step later is not the same step.
    state, _ = play(at((1, 7), (7, 1)), (RIGHT, STAY), (LEFT, DOWN))
    assert not state.collected.any()


def test_collected_diamonds_stay_off_the_board():
    def diamond_codes(timestep):
        board = timestep.state.reshape(10, 10)
        return [board[RED_DIAMOND].item(), board[BLUE_DIAMOND].item()]

    state, _ = play(at(RED_BUTTON, RED_DIAMOND), (STAY, STAY))
    state, (first, second) = play(state, (LEFT, RIGHT), (LEFT, RIGHT))
    assert state.collected.tolist() == [True, False]
    assert diamond_codes(first) == diamond_codes(second) == [0, 7]
    # An uncollected diamond and a button reappear on the board when an agent leaves them.
    _, (on, off) = play(at((8, 2), (1, 2)), (LEFT, LEFT), (RIGHT, RIGHT))
    assert on.state.reshape(10, 10)[[8, 1], [1, 1]].tolist() == [2, 3]
    assert off.state.reshape(10, 10)[[8, 1], [1, 1]].tolist() == [6, 5]


def test_second_diamond_pays_once_and_ends_the_episode():
    # Red is collected; Alice walks from the red to the blue button, Bob to the blue diamond.
    state = at(RED_BUTTON, RED_DIAMOND)
    state, timesteps = play(state, (STAY, STAY), *[(LEFT, RIGHT)] * 7)
    assert [t.reward.item() for t in timesteps] == [0, 0, 0, 0, 0, 0, 0, 1]
    assert [t.terminated.item() for t in timesteps] == [False] * 7 + [True]
    assert not any(t.truncated.item() for t in timesteps)
    assert [t.info["success"].item() for t in timesteps] == [0] * 7 + [1]
    assert [t.info["diamonds"].item() for t in timesteps] == [1] * 7 + [2]
    _, (after,) = play(state, (STAY, STAY))
    assert after.reward == 0


def test_time_limit_truncates_unless_the_task_is_done():
    _, (before, last) = play(at((4, 4), (5, 5), time=98), (STAY, STAY), (STAY, STAY))
    assert not before.done
    assert last.truncated
    assert not last.terminated
    state = at(BLUE_BUTTON, BLUE_DIAMOND, collected=(True, False), time=99)
    _, (success,) = play(state, (STAY, STAY))
    assert success.terminated
    assert not success.truncated
    assert success.reward == 1


def test_starts_are_distinct_and_uniform():
    num = 64 * 63 * 5
    position = jax.jit(jax.vmap(lambda key: CODES.reset(key)[0].position))(
        jax.random.split(jax.random.key(0), num)
    )
    cell = (np.asarray(position) - 1) @ [8, 1]
    assert (cell[:, 0] != cell[:, 1]).all()
    for counts in (np.bincount(cell[:, 0], minlength=64), np.bincount(cell[:, 1], minlength=64)):
        # 63 degrees of freedom: 103.4 is exceeded with probability 0.001.
        assert ((counts - num / 64) ** 2 / (num / 64)).sum() < 103.4
    pairs = np.bincount(cell @ [64, 1], minlength=64 * 64).reshape(64, 64)
    others = pairs[~np.eye(64, dtype=bool)]
    # 4031 degrees of freedom: mean 4031, standard deviation sqrt(2 * 4031) = 90, 3.1 of them.
    assert ((others - 5) ** 2 / 5).sum() < 4031 + 3.1 * 90


# Observations


def test_codes_by_hand():
    timestep = observe_codes(at((1, 2), (2, 3), collected=(True, False)))
    board = np.zeros((10, 10))
    board[[0, -1]] = board[:, [0, -1]] = 1
    board[1, 1], board[1, 8] = 5, 4  # Blue and red button.
    board[8, 8] = 7  # Blue diamond; the red one is collected.
    board[1, 2], board[2, 3] = 2, 3
    np.testing.assert_array_equal(timestep.state, board.ravel())
    np.testing.assert_array_equal(timestep.obs[0], [1, 1, 1, 5, 2, 0, 0, 0, 3, 1, 2])
    np.testing.assert_array_equal(timestep.obs[1], [2, 0, 0, 0, 3, 0, 0, 0, 0, 2, 3])
    assert timestep.action_mask.all()


def test_one_hot_by_hand():
    timestep = observe_one_hot(at((7, 2), (6, 3), collected=(False, True)))
    rows_cols = np.eye(8)
    alice = [
        *rows_cols[6],
        *rows_cols[1],
        1,
        0,
        *np.eye(9)[2],
        1,
        0,
    ]  # Partner at row - 1, col + 1.
    bob = [*rows_cols[5], *rows_cols[2], 0, 1, *np.eye(9)[6], 0, 0]  # Partner: row + 1, col - 1.
    np.testing.assert_array_equal(timestep.obs, [alice, bob])
    places = [*rows_cols[6], *rows_cols[1], *rows_cols[5], *rows_cols[2]]
    np.testing.assert_array_equal(timestep.state, [*places, 0, 1])


def test_agent_1_hides_agent_0():
    timestep = observe_codes(at((4, 4), (4, 4)))
    assert timestep.state.reshape(10, 10)[4, 4] == 3
    assert timestep.obs[:, 4].tolist() == [3, 3]


def empty_board():
    board = np.zeros((10, 10))
    board[[0, -1]] = board[:, [0, -1]] = 1
    board[RED_BUTTON], board[BLUE_BUTTON] = 4, 5
    return board


def codes_of_one_hot(obs, state):
    """Convert the one-hot encoding to codes, from knowledge of the empty board alone."""
    board = empty_board()
    for index, diamond in enumerate((RED_DIAMOND, BLUE_DIAMOND)):
        board[diamond] = 0 if state[32 + index] else 6 + index
    places = state[:32].reshape(4, 8).argmax(1).reshape(2, 2) + 1
    for agent in range(2):
        board[tuple(places[agent])] = 2 + agent

    patches = []
    for own in obs:
        row, col = own[:8].argmax() + 1, own[8:16].argmax() + 1
        index, near, visible = own[16:18].argmax(), own[18:27], own[27:]
        seen = empty_board()
        for diamond, code, there in zip((RED_DIAMOND, BLUE_DIAMOND), (6, 7), visible):
            seen[diamond] = code * there
        patch = seen[row - 1 : row + 2, col - 1 : col + 2].ravel()
        for agent in range(2):  # Agent 1 hides agent 0.
            where = 4 if agent == index else near.argmax()
            if agent == index or near.any():
                patch[where] = 2 + agent
        patches.append([*patch, row, col])
    return np.array(patches), board.ravel()


def one_hot_of_codes(obs, state):
    """Convert codes to the one-hot encoding, for agents on different cells without diamonds."""
    board = state.reshape(10, 10)
    rows_cols = np.eye(8)
    places = [np.argwhere(board == 2 + agent)[0] - 1 for agent in range(2)]
    collected = [board[RED_DIAMOND] != 6, board[BLUE_DIAMOND] != 7]
    global_state = [*(x for place in places for i in place for x in rows_cols[i]), *collected]
    own = []
    for codes in obs:
        patch, (row, col) = codes[:9], codes[9:].astype(int) - 1
        index = int(patch[4]) - 2
        near, visible = patch == 3 - index, [6 in patch, 7 in patch]
        own.append([*rows_cols[row], *rows_cols[col], *np.eye(2)[index], *near, *visible])
    return np.array(own, float), np.array(global_state, float)


cell = st.tuples(st.integers(1, 8), st.integers(1, 8))
corner = st.sampled_from([RED_BUTTON, BLUE_BUTTON, RED_DIAMOND, BLUE_DIAMOND, (7, 1), (7, 7)])


@settings(max_examples=300, deadline=None, derandomize=True)
@given(cell | corner, cell | corner, st.tuples(st.booleans(), st.booleans()))
def test_encodings_contain_the_same_facts(alice, bob, collected):
    state = at(alice, bob, collected)
    codes, one_hot = (
        [np.asarray(x) for x in (timestep.obs, timestep.state)]
        for timestep in (observe_codes(state), observe_one_hot(state))
    )
    for expected, got in zip(codes, codes_of_one_hot(*one_hot)):
        np.testing.assert_array_equal(got, expected)
    if alice != bob and not {alice, bob} & {RED_DIAMOND, BLUE_DIAMOND}:
        for expected, got in zip(one_hot, one_hot_of_codes(*codes)):
            np.testing.assert_array_equal(got, expected)


# Odds and pictures


def test_odds_of_random_play():
    """Uniformly random actions collect a diamond in 4.7 % of episodes (of 100k simulated ones)."""
    num = 20_000

    def step(env_state, key):
        key_step, key_action = jax.random.split(key)
        action = jax.random.randint(key_action, (num, 2), 0, 5)
        env_state, timestep = jax.vmap(CODES.step, (None, 0, 0))(key_step, env_state, action)
        return env_state, timestep.terminated

    @jax.jit
    def simulate(key):
        key_reset, key_play = jax.random.split(key)
        env_state, _ = jax.vmap(CODES.reset)(jax.random.split(key_reset, num))
        return jax.lax.scan(step, env_state, jax.random.split(key_play, 100))

    env_state, terminated = simulate(jax.random.key(1))
    assert (env_state.time == 100).all()
    # Standard error sqrt(0.047 * 0.953 / 20000) = 0.15 %, plus 0.05 % for the rounded 4.7.
    assert abs(env_state.collected.any(1).mean() - 0.047) < 3 * 0.0015 + 0.0005
    # Success has probability 0.024 %: 5 of 20000 expected, above 14 in one of 7000 such tests.
    assert terminated.any(0).sum() <= 14


def test_frame_shows_agents_and_diamonds():
    def colors(state):
        frame = CODES.render(state)
        assert frame.shape == (320, 320, 3)
        return {tuple(color) for color in frame.reshape(-1, 3).tolist()}

    alice, bob, red, blue = (231, 150, 40), (60, 150, 92), (206, 64, 64), (58, 104, 196)
    assert colors(at((4, 4), (5, 5))) >= {alice, bob, red, blue}
    assert colors(at((4, 4), (4, 4))) >= {alice, bob}  # Both are visible on a shared cell.
    frames = [CODES.render(at((4, 4), (5, 5), (taken, False))) for taken in (False, True)]
    row, col = np.array(RED_DIAMOND) * 32 + 16
    assert tuple(frames[0][row, col]) == red
    assert tuple(frames[1][row, col]) != red
