"""Alice_and_Bob: two agents, two buttons, two diamonds (paper Sec. 4.1, Figs. 4 and 9).

The board is a 10x10 array with a wall border; positions are (row, col) in 1..8. A diamond is
collected in a step after which an agent stands on the diamond while an agent stands on the
button of the same color. The team is paid 1 once, when both diamonds are collected.

Follows the authors' game, except that a cell shared by two agents keeps showing the one who
stays when the other leaves (theirs shows it empty until the next move; positions and rewards
are the same).
"""

from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs_jax.choices import check_choice
from envs_jax.types import TimeStep

Observation = Literal["codes", "one_hot"]

SIZE = 8  # interior cells per side
CELLS = SIZE * SIZE
MOVES = np.array([(0, 1), (0, -1), (-1, 0), (1, 0), (0, 0)])  # col+1, col-1, row-1, row+1, stay
BUTTONS = np.array([(1, 8), (1, 1)])  # red, blue
DIAMONDS = np.array([(8, 1), (8, 8)])  # red, blue
PATCH = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])

EMPTY, WALL, AGENT, BUTTON, DIAMOND = 0, 1, 2, 4, 6  # the last three: + index 0 or 1
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
    """Whether the red and the blue diamond are collected."""
    time: Int[Array, "*batch"]
    """Steps taken."""


@dataclass(frozen=True)
class AliceAndBob:
    """The game; see the module docstring for its rules.

    Raises:
        ValueError: `max_steps` is not positive, or `observation` is unknown.
    """

    max_steps: int = 100
    """Time limit of an episode in environment steps."""
    observation: Observation = "codes"
    """How obs and state are written down.

    `codes` is the authors' form: obs (11) is the 3x3 patch of integer cell codes around the
    agent and its (row, col); state (100) is the whole board of codes. Codes: 0 empty, 1 wall,
    2/3 agent, 4/5 button, 6/7 diamond (red/blue). `one_hot` writes the same without an
    arbitrary order between codes: obs (29) is own row (8), own column (8), own index (2),
    where in the patch the partner is (9), and whether each diamond is visible in it (2);
    state (34) is rows and columns of both agents and whether each diamond is collected. It tells
    two things more than the codes, which show one thing per cell: whether the diamond under an
    agent is collected (state), and which of two agents on one cell one is (obs).
    """

    num_agents: ClassVar[int] = 2
    num_actions: ClassVar[int] = len(MOVES)
    agent_names: ClassVar[tuple[str, ...]] = ("Alice", "Bob")
    agent_colors: ClassVar[tuple] = (COLORS["alice"], COLORS["bob"])

    def __post_init__(self) -> None:
        if self.max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {self.max_steps}")
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
        """Place the agents on two distinct uniformly random cells; nothing is collected yet."""
        # One draw among the ordered pairs: a choice without replacement sorts all cells, which
        # cost 4-5 % of a whole training step where every copy prepares a reset at every step.
        first, second = jnp.divmod(jax.random.randint(key, (), 0, CELLS * (CELLS - 1)), CELLS - 1)
        cells = jnp.stack([first, second + (second >= first)])
        position = jnp.stack([cells // SIZE, cells % SIZE], axis=-1) + 1
        state = AliceAndBobState(position, jnp.zeros(2, bool), jnp.int32(0))
        return state, self._timestep(state, jnp.float32(0))

    def step(
        self, key: jax.Array, env_state: AliceAndBobState, action: Int[Array, " agents"]
    ) -> tuple[AliceAndBobState, TimeStep]:
        """Move both agents (walls block, agents do not), then collect. `key` is not used."""
        del key
        position = jnp.clip(env_state.position + jnp.asarray(MOVES)[action], 1, SIZE)
        pressed = _occupied(position, BUTTONS)
        collected = env_state.collected | (pressed & _occupied(position, DIAMONDS))
        success = collected.all() & ~env_state.collected.all()
        state = AliceAndBobState(position, collected, env_state.time + 1)
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

    def render(self, env_state: AliceAndBobState) -> np.ndarray:
        """Draw the board: buttons as squares, diamonds as rhombi, Alice and Bob as discs."""
        scale = 32
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
    """Which of `cells` has an agent on it."""
    return (position[:, None] == cells).all(-1).any(0)


def _observe_codes(state: AliceAndBobState) -> tuple[Array, Array]:
    """Patches of raw cell codes with own (row, col), and the whole board of codes."""
    board = jnp.asarray(BOARD)
    diamond_codes = jnp.where(state.collected, EMPTY, DIAMOND + np.arange(2))
    board = board.at[tuple(DIAMONDS.T)].set(diamond_codes)
    for agent in range(2):  # the later agent is drawn on top
        board = board.at[tuple(state.position[agent])].set(AGENT + agent)
    around = state.position[:, None] + PATCH  # (agents, 9, 2)
    patch = board[around[..., 0], around[..., 1]]
    obs = jnp.concatenate([patch, state.position], axis=-1)
    return obs.astype(jnp.float32), board.reshape(-1).astype(jnp.float32)


def _observe_one_hot(state: AliceAndBobState) -> tuple[Array, Array]:
    """The facts of `_observe_codes` as indicators."""
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
    """Color the pixels of `cell` where `mask` (side, side) is true."""
    side = len(mask)
    row, col = (int(c) * side for c in cell)
    image[row : row + side, col : col + side][mask] = color
