"""Overcooked: two cooks, one kitchen, soups of three onions (paper Sec. 4.2; Carroll et al. 2019).

The rules are those of `overcooked_ai` for soups made of onions, either the current ones or those of
the 2019 paper (`start_cooking`). In one step, first player 0 and then player 1 interact with the
cell that they face. Then both move, unless they would collide. Then every started pot cooks for one
step. The team receives 20 for a delivered soup of three onions and nothing for any other. Only the
seats at reset are random.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from envs_jax.choices import check_choice, check_whole, show
from envs_jax.overcooked import features, kitchen_state, layouts, lossless
from envs_jax.overcooked.layouts import Kitchen
from envs_jax.overcooked.render import COOKS, SIDE, draw
from envs_jax.overcooked.rules import (
    NOTHING,
    NUM_ITEMS,
    StartCooking,
    cook,
    count_uses,
    use_table,
)
from envs_jax.types import TimeStep

Observation = Literal["features", "lossless"]
State = Literal["obs", "kitchen"]

NORTH, SOUTH, EAST, WEST, STAY, INTERACT = range(6)
REWARD = 20


class OvercookedState(NamedTuple):
    """Simulator state of one episode. `rules` defines items and cell states, `Kitchen` cells."""

    pose: Int[Array, "*batch 2"]
    """4 * cell + orientation (0 north, 1 south, 2 east, 3 west) of each player."""
    held: Int[Array, "*batch 2"]
    """Item that each player holds."""
    grid: Int[Array, "*batch cells"]
    """State of each cell."""
    time: Int[Array, "*batch"]
    """Steps taken."""
    soups: Int[Array, "*batch"]
    """Soups of three onions delivered."""
    swapped: Bool[Array, "*batch"]
    """True if agent 0 is player 1 and agent 1 is player 0."""


@dataclass(frozen=True)
class Overcooked:
    """Overcooked as an environment; the module docstring states the rules.

    Actions: 0 north, 1 south, 2 east, 3 west, 4 stay, 5 interact.

    Raises:
        ValueError: `max_steps` is not a positive whole number, a choice is unknown, or `layout` is
            neither a known name nor a valid kitchen.
    """

    layout: str = "cramped_room"
    """Key of `layouts.LAYOUTS`, or your own kitchen written in the same letters."""
    start_cooking: StartCooking = "interact"
    """Rule that starts a pot.

    `interact`: a pot with 1 to 3 onions starts when a player with empty hands interacts with it
    (`overcooked_ai` since 2020, and HMASD). `auto`: a pot starts with its third onion (Carroll et
    al. 2019, and JaxMARL).
    """
    observation: Observation = "features"
    """Encoding of obs.

    `features` is HMASD's encoding (96) as in the module `features`. It shows neither objects on
    counters nor the time. `lossless` (26 per cell) is as in the module `lossless`.
    """
    state: State = "obs"
    """Encoding of the global state.

    `obs` goes with the observation. With `features`, as in HMASD, it is the obs of both agents
    (192). With `lossless` it is the obs of player 0, whichever agent that is, followed by the
    fraction of the time limit that has passed. `kitchen` is as in the module `kitchen_state`, 19
    numbers and 5 per pot: it tells the pots apart, and the seats.
    """
    random_seats: bool = True
    """If True, a coin toss at each reset decides which agent is which player, as in HMASD."""
    max_steps: int = 400
    """Time limit of an episode in environment steps."""

    num_agents: ClassVar[int] = 2
    num_actions: ClassVar[int] = 6
    agent_colors: ClassVar[tuple] = COOKS
    cell_pixels: ClassVar[int] = SIDE
    action_names: ClassVar[tuple[str, ...]] = (
        "north", "south", "east", "west", "stay", "interact",
    )  # fmt: skip

    def __post_init__(self) -> None:
        if not isinstance(self.layout, str):
            raise ValueError(f"layout must be a name or lines of text, got {show(self.layout)}")
        layouts.read(self.layout)
        check_whole("max_steps", self.max_steps)
        check_choice("start_cooking", self.start_cooking, StartCooking)
        check_choice("observation", self.observation, Observation)
        check_choice("state", self.state, State)
        check_choice("random_seats", self.random_seats, Literal[True, False])

    @property
    def kitchen(self) -> Kitchen:
        """Cells and geometry of `layout`."""
        return layouts.read(self.layout)

    @property
    def obs_dim(self) -> int:
        """Length of an agent's observation vector."""
        if self.observation == "features":
            return features.OBS_DIM
        return lossless.CHANNELS * len(self.kitchen.grid)

    @property
    def state_dim(self) -> int:
        """Length of the global state vector."""
        if self.state == "kitchen":
            return kitchen_state.state_dim(self.layout)
        return 2 * self.obs_dim if self.observation == "features" else self.obs_dim + 1

    def reset(self, key: jax.Array) -> tuple[OvercookedState, TimeStep]:
        """Start an episode: players at their places, facing north, with empty hands and pots."""
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
        # A trainer may prepare a reset in every copy at every step, so resets must be cheap. The
        # coin is one bit of the key, which is random already, and obs is encoded only once.
        swapped = (jax.random.key_data(key)[-1] & 1).astype(bool)
        env_state = env_state._replace(swapped=swapped)
        obs = _reorder(timestep.obs, swapped)
        state = self._global_state(env_state, obs)
        return env_state, timestep._replace(obs=obs, state=state)

    def step(
        self, key: jax.Array, env_state: OvercookedState, action: Int[Array, " agents"]
    ) -> tuple[OvercookedState, TimeStep]:
        """Advance one step: interact, move, cook. `key` is not used."""
        del key
        action = _reorder(action, env_state.swapped).astype(jnp.int32)
        grid, held, soups = self._interact(env_state, action == INTERACT)
        env_state = OvercookedState(
            pose=_move(self.kitchen, env_state.pose, action),
            held=held,
            grid=cook(grid, self.start_cooking),
            time=env_state.time + 1,
            soups=env_state.soups + soups,
            swapped=env_state.swapped,
        )
        return env_state, self._timestep(env_state, REWARD * soups.astype(jnp.float32))

    def _interact(
        self, state: OvercookedState, acts: Bool[Array, "2"]
    ) -> tuple[Int[Array, " cells"], Int[Array, "2"], Int[Array, ""]]:
        """Let player 0 and then player 1 use the cell that they face.

        Args:
            state: State before the step.
            acts: True for each player that interacts.

        Returns:
            The new grid, the items held, and the number of soups that earn a reward.
        """
        table = jnp.asarray(use_table(self.start_cooking))
        front = jnp.asarray(self.kitchen.front)[state.pose]
        cells = np.arange(len(state.grid))
        grid, held, soups = state.grid, [], jnp.int32(0)
        before = state.grid[front]
        for player in range(2):
            result = table[NUM_ITEMS * before[player] + state.held[player]]
            after = jnp.where(acts[player], result >> 4, before[player])
            grid = jnp.where(cells == front[player], after, grid)
            held.append(jnp.where(acts[player], result >> 1 & 7, state.held[player]))
            soups += jnp.where(acts[player], result & 1, 0)
            # If both players face this cell, player 1 finds the new state.
            before = jnp.where(front == front[player], after, before)
        return grid, jnp.stack(held), soups

    def _timestep(self, state: OvercookedState, reward: Float[Array, ""]) -> TimeStep:
        obs = self._observe(state)
        return TimeStep(
            obs=obs,
            state=self._global_state(state, obs),
            action_mask=jnp.ones((self.num_agents, self.num_actions), bool),
            reward=reward,
            terminated=jnp.bool(False),
            truncated=state.time >= self.max_steps,
            info={"soups": state.soups.astype(jnp.float32)},
        )

    def _observe(self, state: OvercookedState) -> Float[Array, "agents obs"]:
        if self.observation == "features":
            pose, held = (_reorder(x, state.swapped) for x in (state.pose, state.held))
            return features.observe(self.layout, pose, held, state.grid)
        urgent = self.max_steps - state.time < lossless.URGENT_STEPS
        by_player = lossless.observe(self.kitchen, *state[:3], urgent)
        return _reorder(by_player, state.swapped)

    def _global_state(
        self, state: OvercookedState, obs: Float[Array, "agents obs"]
    ) -> Float[Array, " state"]:
        if self.state == "kitchen":
            return kitchen_state.encode(
                self.layout, state.pose, state.held, state.grid, state.swapped
            )
        if self.observation == "features":
            return obs.reshape(-1)
        by_player = _reorder(obs, state.swapped)
        return jnp.append(by_player[0], state.time / self.max_steps)

    def events(
        self, before: OvercookedState, action: Int[Array, " agents"], after: OvercookedState
    ) -> dict[str, Float[Array, " agents"]]:
        """Count what each agent took, put down, cooked and served."""
        swapped = before.swapped
        by_player = _reorder(action, swapped)
        front = jnp.asarray(self.kitchen.front)[before.pose]
        interacts = by_player == INTERACT
        counts = count_uses(before.grid[front], after.grid[front], before.held, after.held)
        counts = {name: count & interacts for name, count in counts.items()}
        # Player 0 is first. A pot starts once, or by itself.
        started, twice = counts["pot started"], front[0] == front[1]
        started = started.at[1].set(started[1] & ~(started[0] & twice))
        counts["pot started"] = started & (self.start_cooking == "interact")
        return {name: _reorder(x.astype(jnp.float32), swapped) for name, x in counts.items()}

    def locate(self, env_state: OvercookedState) -> Float[Array, "agents 2"]:
        """Return the center of each agent's cell in the picture."""
        cell = _reorder(env_state.pose, env_state.swapped) // 4
        width = self.kitchen.width
        return (jnp.stack([cell % width, cell // width], axis=-1) + 0.5) * SIDE

    def render(self, env_state: OvercookedState) -> np.ndarray:
        """Draw the kitchen, with agent 0 in blue and agent 1 in red on either seat."""
        return draw(self.kitchen, env_state)


def _reorder(values: Shaped[Array, "2 *rest"], swapped: Bool[Array, ""]):
    """Bring values of each player into the order of the agents, or the other way around."""
    return jnp.where(swapped, values[::-1], values)


def _move(kitchen: Kitchen, pose: Int[Array, "2"], action: Int[Array, "2"]) -> Int[Array, "2"]:
    """Turn, and walk onto free floor; nobody walks if the two would collide or swap places."""
    target = jnp.asarray(kitchen.moved)[6 * pose + action]
    cell, ahead = pose // 4, target // 4
    collide = (ahead[0] == ahead[1]) | (ahead == cell[::-1]).all()
    return jnp.where(collide, 4 * cell + target % 4, target)
