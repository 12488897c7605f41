"""Alice_and_Bob: two agents, two buttons, two diamonds (paper Sec. 4.1, Figs. 4 and 9).

The board is a 10x10 array with a border of walls, and positions are (row, col) in 1..8. A diamond
is collected when, after a step, one agent stands on it and another agent stands on the button of
the same color. The team receives a reward of 1 once, when both diamonds are collected.

The rules follow the authors' game with one difference. When two agents share a cell and one of them
leaves, this cell shows the agent that stays. In the authors' game it looks empty until the next
move. Positions and rewards are the same.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs_jax.choices import check_choice, check_whole
from envs_jax.types import TimeStep

Observation = Literal["codes", "one_hot"]

SIZE = 8  # Interior cells per side.
CELLS = SIZE * SIZE
SCALE = 32  # Pixels per cell of the picture.
MOVES = np.array([(0, 1), (0, -1), (-1, 0), (1, 0), (0, 0)])  # Right, left, up, down, stay.
BUTTONS = np.array([(1, 8), (1, 1)])  # Red, blue.
DIAMONDS = np.array([(8, 1), (8, 8)])  # Red, blue.
PATCH = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])

# Codes of cells. The last three are those of index 0; add 1 for index 1.
EMPTY, WALL, AGENT, BUTTON, DIAMOND = 0, 1, 2, 4, 6
BOARD = np.pad(np.full((SIZE, SIZE), EMPTY), 1, constant_values=WALL)
BOARD[tuple(BUTTONS.T)] = (BUTTON, BUTTON + 1)

COLORS = {
    "floor": (244, 241, 232),
    "line": (214, 208, 192),
    "wall": (84, 88, 99),
    "red": (206, 64, 64),
    "blue": (58, 104, 196),
    "alice": (231, 150, 40),
    "bob": (60, 150, 92),
}


class AliceAndBobState(NamedTuple):
    """Simulator state of one episode."""

    position: Int[Array, "*batch 2 2"]
    """(row, col) of each agent, 1..8."""
    collected: Bool[Array, "*batch 2"]
    """True for each diamond, red and blue, that is collected."""
    time: Int[Array, "*batch"]
    """Steps taken."""


@dataclass(frozen=True)
class AliceAndBob:
    """Alice_and_Bob as an environment; the module docstring states the rules.

    Actions: 0 right, 1 left, 2 up, 3 down, 4 stay.

    Raises:
        ValueError: `max_steps` is not a positive whole number, or `observation` is unknown.
    """

    max_steps: int = 100
    """Time limit of an episode in environment steps."""
    observation: Observation = "codes"
    """Encoding of obs and state.

    `codes` is the authors' encoding. obs (11) is the 3x3 patch of integer cell codes around the
    agent, followed by its (row, col). state (100) is the whole board of codes. Codes: 0 empty,
    1 wall, 2/3 agent, 4/5 button, 6/7 diamond (red/blue).

    `one_hot` encodes the same facts without an arbitrary order between codes. obs (29) is the
    agent's row (8), column (8) and index (2), the place of the partner in the patch (9), and
    visibility of each diamond in the patch (2). state (34) is the rows and columns of both agents,
    and for each diamond whether it is collected. Codes show one thing per cell, so this encoding
    contains two facts more: whether the diamond under an agent is collected (state), and which of
    the two agents on a shared cell the observer is (obs).
    """

    num_agents: ClassVar[int] = 2
    num_actions: ClassVar[int] = len(MOVES)
    agent_names: ClassVar[tuple[str, ...]] = ("Alice", "Bob")
    action_names: ClassVar[tuple[str, ...]] = ("right", "left", "up", "down", "stay")
    agent_colors: ClassVar[tuple] = (COLORS["alice"], COLORS["bob"])
    cell_pixels: ClassVar[int] = SCALE

    def __post_init__(self) -> None:
        check_whole("max_steps", self.max_steps)
        check_choice("observation", self.observation, Observation)

    @property
    def obs_dim(self) -> int:
        """Length of an agent's observation vector."""
        return 11 if self.observation == "codes" else 29

    @property
    def state_dim(self) -> int:
        """Length of the global state vector."""
        return 100 if self.observation == "codes" else 34

    def reset(self, key: jax.Array) -> tuple[AliceAndBobState, TimeStep]:
        """Place the agents on two distinct uniformly random cells, with no diamond collected."""
        # Draw one of the ordered pairs of cells. A choice without replacement sorts all cells, and
        # took 4-5 % of a training step in which every copy prepares a reset at every step.
        first, second = jnp.divmod(jax.random.randint(key, (), 0, CELLS * (CELLS - 1)), CELLS - 1)
        cells = jnp.stack([first, second + (second >= first)])
        position = jnp.stack([cells // SIZE, cells % SIZE], axis=-1) + 1
        state = AliceAndBobState(position=position, collected=jnp.zeros(2, bool), time=jnp.int32(0))
        return state, self._timestep(state, jnp.float32(0))

    def step(
        self, key: jax.Array, env_state: AliceAndBobState, action: Int[Array, " agents"]
    ) -> tuple[AliceAndBobState, TimeStep]:
        """Move both agents, then collect. Walls block, agents do not. `key` is not used."""
        del key
        position = jnp.clip(env_state.position + jnp.asarray(MOVES)[action], 1, SIZE)
        pressed = _occupied(position, BUTTONS)
        collected = env_state.collected | (pressed & _occupied(position, DIAMONDS))
        success = collected.all() & ~env_state.collected.all()
        state = AliceAndBobState(position=position, collected=collected, time=env_state.time + 1)
        return state, self._timestep(state, success.astype(jnp.float32))

    def _timestep(self, state: AliceAndBobState, reward: Float[Array, ""]) -> TimeStep:
        success = state.collected.all()
        observe = _observe_codes if self.observation == "codes" else _observe_one_hot
        obs, global_state = observe(state)
        return TimeStep(
            obs=obs,
            state=global_state,
            action_mask=jnp.ones((self.num_agents, self.num_actions), bool),
            reward=reward,
            terminated=success,
            truncated=(state.time >= self.max_steps) & ~success,
            info={
                "success": success.astype(jnp.float32),
                "diamonds": state.collected.sum().astype(jnp.float32),
            },
        )

    def events(
        self, before: AliceAndBobState, action: Int[Array, " agents"], after: AliceAndBobState
    ) -> dict[str, Float[Array, " agents"]]:
        """Count diamonds by the agent that stands on them, and buttons by their color."""
        del action
        counts = {}
        collected = after.collected & ~before.collected
        for index, color in enumerate(("red", "blue")):
            on_diamond = (after.position == DIAMONDS[index]).all(-1)
            on_button = (after.position == BUTTONS[index]).all(-1)
            was_there = (before.position == BUTTONS[index]).all(-1)
            counts[f"{color} diamond collected"] = on_diamond & collected[index]
            counts[f"{color} button pressed"] = on_button & ~was_there
        return {name: count.astype(jnp.float32) for name, count in counts.items()}

    def locate(self, env_state: AliceAndBobState) -> Float[Array, "agents 2"]:
        """Return the center of each agent's cell in the picture."""
        return (env_state.position[:, ::-1] + 0.5) * SCALE

    def render(self, env_state: AliceAndBobState) -> np.ndarray:
        """Draw the board, with buttons as squares, diamonds as rhombi and agents as discs."""
        scale = SCALE
        board = np.array(BOARD)
        cells = np.where((board == WALL)[..., None], COLORS["wall"], COLORS["floor"])
        image = cells.repeat(scale, 0).repeat(scale, 1).astype(np.uint8)
        image[scale:-scale:scale, scale:-scale] = COLORS["line"]
        image[scale:-scale, scale:-scale:scale] = COLORS["line"]
        y, x = (np.mgrid[:scale, :scale] + 0.5) / scale - 0.5
        square, rhombus = np.maximum(abs(x), abs(y)) < 0.42, abs(x) + abs(y) < 0.42
        for index, color in enumerate(("red", "blue")):
            _paint(image, BUTTONS[index], square, COLORS[color])
            if not env_state.collected[index]:
                _paint(image, DIAMONDS[index], rhombus, COLORS[color])
        position = np.asarray(env_state.position)
        offset = 0.16 if (position[0] == position[1]).all() else 0.0
        for index, name in enumerate(("alice", "bob")):
            center = offset * (2 * index - 1)
            _paint(image, position[index], np.hypot(x - center, y) < 0.28, (30, 30, 30))
            _paint(image, position[index], np.hypot(x - center, y) < 0.24, COLORS[name])
        return image


def _occupied(position: Int[Array, "2 2"], cells: np.ndarray) -> Bool[Array, " cells"]:
    """Return for each of `cells` whether an agent stands on it."""
    return (position[:, None] == cells).all(-1).any(0)


def _observe_codes(state: AliceAndBobState) -> tuple[Array, Array]:
    """Encode each agent's patch and (row, col), and the whole board, as integer codes."""
    board = jnp.asarray(BOARD)
    diamond_codes = jnp.where(state.collected, EMPTY, DIAMOND + np.arange(2))
    board = board.at[tuple(DIAMONDS.T)].set(diamond_codes)
    for agent in range(2):  # On a shared cell agent 1 hides agent 0.
        board = board.at[tuple(state.position[agent])].set(AGENT + agent)
    around = state.position[:, None] + PATCH  # (agents, 9, 2)
    patch = board[around[..., 0], around[..., 1]]
    obs = jnp.concatenate([patch, state.position], axis=-1)
    return obs.astype(jnp.float32), board.reshape(-1).astype(jnp.float32)


def _observe_one_hot(state: AliceAndBobState) -> tuple[Array, Array]:
    """Encode the facts of `_observe_codes` as indicators."""
    places = jax.nn.one_hot(state.position - 1, SIZE).reshape(2, 2 * SIZE)
    partner = state.position[::-1, None] - state.position[:, None]  # (agents, 1, 2)
    near = (partner == PATCH).all(-1)
    distance = abs(state.position[:, None] - DIAMONDS).max(-1)  # (agents, diamonds)
    covered = _occupied(state.position, DIAMONDS)
    visible = (distance <= 1) & ~state.collected & ~covered
    obs = jnp.concatenate([places, jnp.eye(2), near, visible], axis=-1)
    global_state = jnp.concatenate([places.reshape(-1), state.collected])
    return obs.astype(jnp.float32), global_state.astype(jnp.float32)


def _paint(image: np.ndarray, cell: np.ndarray, mask: np.ndarray, color: tuple) -> None:
    """Color those pixels of `cell` at which `mask` (side, side) is true."""
    side = len(mask)
    row, col = (int(c) * side for c in cell)
    image[row : row + side, col : col + side][mask] = color
