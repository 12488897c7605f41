"""Overcooked: two cooks, one kitchen, soups of three onions (paper Sec. 4.2; Carroll et al. 2019).

Follows `overcooked_ai`, its current rules or those of the 2019 paper (`start_cooking`), for
soups made of onions. In one step first player 0 and then player 1 interact with what they face;
then both move, unless they would collide; then all pots cook on. A delivered soup of three onions
pays the team 20, any other nothing. Only the seats at reset are random.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs_jax.choices import check_choice
from envs_jax.overcooked import features as overcooked_features
from envs_jax.overcooked import layouts as overcooked_kitchen
from envs_jax.overcooked import lossless as overcooked_lossless
from envs_jax.overcooked import render as overcooked_drawing
from envs_jax.overcooked.layouts import Kitchen
from envs_jax.overcooked.rules import NOTHING, NUM_ITEMS, StartCooking, cook, use_table
from envs_jax.types import TimeStep

Observation = Literal["features", "lossless"]

NORTH, SOUTH, EAST, WEST, STAY, INTERACT = range(6)
REWARD = 20


class OvercookedState(NamedTuple):
    """Simulator state of one episode. `overcooked_rules` has the codes, `Kitchen` the cells."""

    pose: Int[Array, "*batch 2"]
    """4 * cell + orientation (0 north, 1 south, 2 east, 3 west) of each player."""
    held: Int[Array, "*batch 2"]
    """What each player holds."""
    grid: Int[Array, "*batch cells"]
    """State of each cell."""
    time: Int[Array, "*batch"]
    """Steps taken."""
    soups: Int[Array, "*batch"]
    """Soups of three onions delivered."""
    swapped: Bool[Array, "*batch"]
    """Whether agent 0 is player 1, and agent 1 player 0."""


@dataclass(frozen=True)
class Overcooked:
    """The game; see the module docstring for its rules.

    Actions: 0 north, 1 south, 2 east, 3 west, 4 stay, 5 interact.

    Raises:
        ValueError: `max_steps` is not positive, a choice is unknown, or `layout` is neither a name
            nor a kitchen that can be played in.
    """

    layout: str = "cramped_room"
    """A key of `overcooked_kitchen.LAYOUTS`, or a kitchen of one's own in the same letters."""
    start_cooking: StartCooking = "interact"
    """What starts a pot.

    `interact`: an interaction with empty hands, with 1 to 3 onions in it (`overcooked_ai` since
    2020, and HMASD). `auto`: the third onion (Carroll et al. 2019, and JaxMARL).
    """
    observation: Observation = "features"
    """How obs and state are written down.

    `features` is HMASD's form: obs (96) as in `overcooked_features`, state (192) is the obs of both
    agents. They show neither what lies on counters nor the time. `lossless`: obs (26 per cell) as
    in `overcooked_lossless`, state is that of player 0, whichever agent it is, and the part of
    the time limit that has passed.
    """
    random_seats: bool = True
    """Whether a coin tossed at each reset decides which agent is which player, as in HMASD."""
    max_steps: int = 400
    """Time limit of an episode in environment steps."""

    num_agents: ClassVar[int] = 2
    num_actions: ClassVar[int] = 6
    agent_colors: ClassVar[tuple] = overcooked_drawing.COOKS

    def __post_init__(self) -> None:
        overcooked_kitchen.read(self.layout)
        if self.max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {self.max_steps}")
        check_choice("start_cooking", self.start_cooking, StartCooking)
        check_choice("observation", self.observation, Observation)

    @property
    def kitchen(self) -> Kitchen:
        """The layout, read."""
        return overcooked_kitchen.read(self.layout)

    @property
    def obs_dim(self) -> int:
        """Length of an agent's observation vector."""
        if self.observation == "features":
            return overcooked_features.OBS_DIM
        return overcooked_lossless.CHANNELS * len(self.kitchen.grid)

    @property
    def state_dim(self) -> int:
        """Length of the global state vector."""
        return 2 * self.obs_dim if self.observation == "features" else self.obs_dim + 1

    def reset(self, key: jax.Array) -> tuple[OvercookedState, TimeStep]:
        """Put the players at their places, facing north, with nothing in hands or pots."""
        kitchen = self.kitchen
        env_state = OvercookedState(
            pose=jnp.asarray(4 * kitchen.start + NORTH),
            held=jnp.full(2, NOTHING, jnp.int32),
            grid=jnp.asarray(kitchen.grid),
            time=jnp.int32(0),
            soups=jnp.int32(0),
            swapped=jnp.bool(False),
        )
        timestep = self._timestep(env_state, jnp.float32(0))
        if not self.random_seats:
            return env_state, timestep
        # A trainer may prepare a reset in every copy at every step: so the coin is a bit of the key
        # itself, which is random already, and the start is looked at once for both seats.
        swapped = (jax.random.key_data(key)[-1] & 1).astype(bool)
        obs = jnp.where(swapped, timestep.obs[::-1], timestep.obs)
        state = obs.reshape(-1) if self.observation == "features" else timestep.state
        return env_state._replace(swapped=swapped), timestep._replace(obs=obs, state=state)

    def step(
        self, key: jax.Array, env_state: OvercookedState, action: Int[Array, " agents"]
    ) -> tuple[OvercookedState, TimeStep]:
        """Interact, move, cook. `key` is not used."""
        del key
        action = jnp.where(env_state.swapped, action[::-1], action).astype(jnp.int32)
        grid, held, paid = self._interact(env_state, action == INTERACT)
        env_state = OvercookedState(
            pose=_move(self.kitchen, env_state.pose, action),
            held=held,
            grid=cook(grid, self.start_cooking),
            time=env_state.time + 1,
            soups=env_state.soups + paid,
            swapped=env_state.swapped,
        )
        return env_state, self._timestep(env_state, REWARD * paid.astype(jnp.float32))

    def _interact(
        self, state: OvercookedState, acts: Bool[Array, "2"]
    ) -> tuple[Int[Array, " cells"], Int[Array, "2"], Int[Array, ""]]:
        """Let player 0 and then player 1 use what they face; returns grid, held, soups paid."""
        table = jnp.asarray(use_table(self.start_cooking))
        front = jnp.asarray(self.kitchen.front)[state.pose]
        cells = np.arange(len(state.grid))
        grid, hands, paid = state.grid, [], jnp.int32(0)
        before = state.grid[front]
        for player in range(2):
            result = table[NUM_ITEMS * before[player] + state.held[player]]
            after = jnp.where(acts[player], result >> 4, before[player])
            grid = jnp.where(cells == front[player], after, grid)
            hands.append(jnp.where(acts[player], result >> 1 & 7, state.held[player]))
            paid += jnp.where(acts[player], result & 1, 0)
            # The other, if facing the same cell, finds it as it is now.
            before = jnp.where(front == front[player], after, before)
        return grid, jnp.stack(hands), paid

    def _timestep(self, state: OvercookedState, reward: Float[Array, ""]) -> TimeStep:
        if self.observation == "features":
            cooks = (state.pose, state.held)
            pose, held = (jnp.where(state.swapped, x[::-1], x) for x in cooks)
            obs = overcooked_features.observe(self.layout, pose, held, state.grid)
            global_state = obs.reshape(-1)
        else:
            urgent = self.max_steps - state.time < overcooked_lossless.URGENT_STEPS
            views = overcooked_lossless.observe(self.kitchen, *state[:3], urgent)
            obs = jnp.where(state.swapped, views[::-1], views)
            global_state = jnp.append(views[0], state.time / self.max_steps)
        return TimeStep(
            obs=obs,
            state=global_state,
            action_mask=jnp.ones((self.num_agents, self.num_actions), bool),
            reward=reward,
            terminated=jnp.bool(False),
            truncated=state.time >= self.max_steps,
            info={"soups": state.soups.astype(jnp.float32)},
        )

    def render(self, env_state: OvercookedState) -> np.ndarray:
        """Draw the kitchen; agent 0 is blue and agent 1 red, whichever their seats."""
        return overcooked_drawing.draw(self.kitchen, env_state)


def _move(kitchen: Kitchen, pose: Int[Array, "2"], action: Int[Array, "2"]) -> Int[Array, "2"]:
    """Turn, and go ahead where there is floor; none goes if they would meet or change places."""
    target = jnp.asarray(kitchen.moved)[6 * pose + action]
    cell, ahead = pose // 4, target // 4
    collide = (ahead[0] == ahead[1]) | (ahead == cell[::-1]).all()
    return jnp.where(collide, 4 * cell + target % 4, target)
