"""Unit micro-battles: a substitute for SMAC's 3m, 2s_vs_1sc and 2m_vs_1z with 0-1 reward.

Each agent commands one unit against enemies that follow a fixed rule. The team receives a reward of
1 once, when the last enemy dies while one of the agents' units lives, or another reward of
`rewards.py`. Units, walls, starts, actions, masks and observations follow SMAC and StarCraft II's
data files. The game itself was never run. docs/environments/micro_battle.md states what is modeled
and what is not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs_jax.choices import check_choice, check_whole, show, suggest
from envs_jax.micro_battle.constants import column, unit_constants
from envs_jax.micro_battle.copies import copies_last
from envs_jax.micro_battle.events import count
from envs_jax.micro_battle.observations import (
    DIRECTIONS,
    FIRST_ATTACK,
    FIRST_MOVE,
    Format,
    action_mask,
    global_state,
    obs_size,
    observe,
    state_size,
)
from envs_jax.micro_battle.physics import LONG_AGO, NOBODY, Orders, Units, tick
from envs_jax.micro_battle.render import ALLIES, CELL, bounds, draw, surround
from envs_jax.micro_battle.rewards import Reward, team_reward, won
from envs_jax.micro_battle.scenarios import SCENARIOS, Scenario
from envs_jax.micro_battle.unit_types import Balance
from envs_jax.types import TimeStep

TICKS_PER_STEP = 8
"""Ticks of the simulation per environment step, as in SMAC (half a second)."""


class MicroBattleState(NamedTuple):
    """Simulator state of one episode."""

    units: Units
    """Allies, then enemies."""
    goal: Float[Array, "2 *copies"]
    """Destination of the enemies; not used in scenarios without goals."""
    last_action: Int[Array, "agents *copies"]
    """Last action of each agent; -1 at reset."""
    time: Int[Array, "*copies"]
    """Steps taken."""


@dataclass(frozen=True)
class MicroBattle:
    """Micro-battle as an environment; the module docstring states the rules.

    Actions are SMAC's: 0 no-op (only for the dead), 1 stop, 2 to 5 move north (+y), south,
    east (+x), west, and 6 + j attack enemy j. An illegal action acts as stop.

    Raises:
        ValueError: The scenario, the balance, a format or the reward is unknown, or `time_limit` is
            not a positive whole number.
    """

    scenario: str | Scenario = "3m"
    """Name in `scenarios.SCENARIOS`, or your own `Scenario`."""
    balance: Balance = "multi"
    """Unit data of the game: `multi` for those of multiplayer games, `liberty` for those of the
    campaign that SMAC's maps declare. They differ in stalkers and spine crawlers."""
    observation: Format = "mappo"
    """Format of the observations: `mappo` for that of MAPPO's wrapper around SMAC (3m: 64 numbers),
    `smac` for SMAC's own (30)."""
    state: Format | None = None
    """Format of the global state: `mappo` for the wrapper's with one state for all agents (3m: 75
    numbers), `smac` for SMAC's own (48). None is the format of the observations. HMASD's authors
    combine observations of `mappo` with the state of `smac`."""
    time_limit: int | None = None
    """Time limit of an episode in environment steps; None takes that of the scenario."""
    reward: Reward = "win"
    """Reward of the team: `win` for 1 per battle won, `kills` for deaths and the battle, as in
    MASER's fork of SMAC, `damage` for damage, deaths and the battle, as in SMAC."""

    cell_pixels: ClassVar[int] = CELL

    def __post_init__(self) -> None:
        known = isinstance(self.scenario, str) and self.scenario in SCENARIOS
        if not isinstance(self.scenario, Scenario) and not known:
            hint = suggest(self.scenario, SCENARIOS)
            raise ValueError(
                f"scenario {show(self.scenario)} is unknown{hint}; give a known name or a Scenario"
            )
        check_choice("balance", self.balance, Balance)
        check_choice("observation", self.observation, Format)
        if self.state is not None:
            check_choice("state", self.state, Format)
        check_choice("reward", self.reward, Reward)
        if self.time_limit is not None:
            check_whole("time_limit", self.time_limit)

    @property
    def resolved_scenario(self) -> Scenario:
        """The `Scenario`, also if `scenario` is a name."""
        return SCENARIOS[self.scenario] if isinstance(self.scenario, str) else self.scenario

    @property
    def num_agents(self) -> int:
        """Number of allied units."""
        return len(self.resolved_scenario.allies)

    @property
    def num_actions(self) -> int:
        """Number of actions: no-op, stop, four moves, and an attack per enemy."""
        return FIRST_ATTACK + len(self.resolved_scenario.enemies)

    @property
    def obs_dim(self) -> int:
        """Length of an agent's observation vector."""
        return obs_size(self.resolved_scenario, self.observation)

    @property
    def state_dim(self) -> int:
        """Length of the global state vector."""
        return state_size(self.resolved_scenario, self.state or self.observation)

    @property
    def max_steps(self) -> int:
        """Time limit in environment steps."""
        return self.resolved_scenario.max_steps if self.time_limit is None else self.time_limit

    @property
    def agent_names(self) -> tuple[str, ...]:
        """Names of the agents in pictures."""
        return tuple(
            f"{spawn.unit} {i + 1}" for i, spawn in enumerate(self.resolved_scenario.allies)
        )

    @property
    def agent_colors(self) -> tuple[tuple[int, int, int], ...]:
        """Colors of the agents in pictures."""
        return tuple(ALLIES[i % len(ALLIES)] for i in range(self.num_agents))

    def reset(self, key: jax.Array) -> tuple[MicroBattleState, TimeStep]:
        """Start an episode with all units within the scenario's `jitter` of their positions."""
        num_units = self.num_agents + len(self.resolved_scenario.enemies)
        # Draw one word per unit and one for the goal. Half a word is enough for a coordinate.
        return copies_last(self._begin)(jax.random.bits(key, (num_units + 1,)))

    def step(
        self, key: jax.Array, env_state: MicroBattleState, action: Int[Array, " agents"]
    ) -> tuple[MicroBattleState, TimeStep]:
        """Carry out the agents' actions for half a second of game time."""
        luck = jax.random.uniform(key, env_state.units.x.shape)
        return copies_last(self._advance)(env_state, action, luck)

    def _begin(self, bits: Array) -> tuple[MicroBattleState, TimeStep]:
        """Implement `reset` for random words, with copies last."""
        scenario, copies = self.resolved_scenario, bits.shape[1:]
        constants = unit_constants(scenario, self.balance, len(copies))
        fractions = jnp.stack([bits & 0xFFFF, bits >> 16]).astype(jnp.float32) / 2**16
        area, turn = fractions[:, :-1]  # A point of a disc.
        angle = 2 * jnp.pi * turn
        offset = scenario.jitter * jnp.sqrt(area) * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        spawns = (*scenario.allies, *scenario.enemies)
        start = column(np.array([[s.x for s in spawns], [s.y for s in spawns]]), len(copies))
        x, y = start + jnp.where(constants.speed > 0, offset, 0)  # Buildings have fixed places.
        ends = column(np.array(scenario.goals or ((0, 0),), np.float32), len(copies))
        zero, nobody = jnp.zeros_like(x), jnp.full(x.shape, NOBODY, jnp.int32)
        units = Units(
            x=x,
            y=y,
            health=zero + constants.max_health,
            shield=zero + constants.max_shield,
            ready=zero,
            begun=zero + LONG_AGO,
            struck=zero + LONG_AGO,
            shooter=nobody,
            target=nobody,
        )
        state = MicroBattleState(
            units=units,
            goal=ends[0] + (ends[-1] - ends[0]) * fractions[0, -1],
            last_action=nobody[: self.num_agents],
            time=jnp.zeros(copies, jnp.int32),
        )
        return state, self._timestep(state, jnp.zeros(copies))

    def _advance(
        self,
        state: MicroBattleState,
        action: Int[Array, "agents *copies"],
        luck: Float[Array, "units *copies"],
    ) -> tuple[MicroBattleState, TimeStep]:
        """Implement `step` for one random number per unit, with copies last."""
        scenario = self.resolved_scenario
        constants = unit_constants(scenario, self.balance, luck.ndim - 1)
        orders = self._read_orders(action_mask(scenario, state.units), action)
        goal = state.goal if scenario.goals else None

        def advance(units: Units, now: Array) -> tuple[Units, None]:
            return tick(constants, scenario.floor, units, orders, goal, luck, now), None

        now = jnp.arange(TICKS_PER_STEP, dtype=jnp.float32)
        units, _ = jax.lax.scan(advance, state.units, now)
        units = units._replace(
            ready=jnp.maximum(units.ready - TICKS_PER_STEP, 0),
            begun=units.begun - TICKS_PER_STEP,
            struck=units.struck - TICKS_PER_STEP,
        )
        after = MicroBattleState(
            units=units, goal=state.goal, last_action=action.astype(jnp.int32), time=state.time + 1
        )
        reward = team_reward(self.reward, state.units, units, constants, self.num_agents)
        return after, self._timestep(after, reward)

    def _read_orders(
        self, mask: Bool[Array, "agents actions *copies"], action: Int[Array, "agents *copies"]
    ) -> Orders:
        """Turn legal actions into orders. An illegal action becomes stop."""
        ordered = [(action == index) & mask[:, index] for index in range(self.num_actions)]
        toward_x = toward_y = jnp.zeros(action.shape)
        for (dx, dy), moves in zip(DIRECTIONS, ordered[FIRST_MOVE:FIRST_ATTACK], strict=True):
            toward_x, toward_y = jnp.where(moves, dx, toward_x), jnp.where(moves, dy, toward_y)
        target = jnp.full(action.shape, NOBODY, jnp.int32)
        for enemy, attacks in enumerate(ordered[FIRST_ATTACK:], start=self.num_agents):
            target = jnp.where(attacks, enemy, target)
        enemies = jnp.zeros((len(self.resolved_scenario.enemies), *action.shape[1:]))
        return Orders(
            target=jnp.concatenate([target, enemies.astype(jnp.int32)]),
            toward_x=jnp.concatenate([toward_x, enemies]),
            toward_y=jnp.concatenate([toward_y, enemies]),
        )

    def _timestep(self, state: MicroBattleState, reward: Float[Array, "*copies"]) -> TimeStep:
        units, last_action, scenario = state.units, state.last_action, self.resolved_scenario
        constants = unit_constants(scenario, self.balance, units.x.ndim - 1)
        mask = action_mask(scenario, units)
        alive = units.health > 0
        allies, enemies = alive[: self.num_agents], alive[self.num_agents :]
        over = ~allies.any(0) | ~enemies.any(0)
        return TimeStep(
            obs=observe(scenario, self.observation, constants, units, last_action, mask),
            state=global_state(
                scenario, self.state or self.observation, constants, units, last_action
            ),
            action_mask=mask,
            reward=reward,
            terminated=over,
            truncated=(state.time >= self.max_steps) & ~over,
            info={
                "success": won(units, self.num_agents).astype(jnp.float32),
                "allies_alive": allies.sum(0).astype(jnp.float32),
                "enemies_alive": enemies.sum(0).astype(jnp.float32),
            },
        )

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the actions."""
        names = ("no-op", "stop", "north", "south", "east", "west")
        enemies = enumerate(self.resolved_scenario.enemies)
        return names + tuple(f"attack {spawn.unit} {i + 1}" for i, spawn in enemies)

    def events(
        self, before: MicroBattleState, action: Int[Array, " agents"], after: MicroBattleState
    ) -> dict[str, Float[Array, " agents"]]:
        """Count attacks begun, kills, damage and deaths; see `events.count`."""
        del action
        return count(before.units, after.units, self.num_agents, TICKS_PER_STEP)

    def locate(self, env_state: MicroBattleState) -> Float[Array, "agents 2"]:
        """Return the place of each living agent in the picture."""
        left, _, _, top = bounds(self.resolved_scenario.floor)
        units = jax.tree.map(lambda x: x[: self.num_agents], env_state.units)
        place = jnp.stack([units.x - left, top - units.y], axis=-1) * CELL
        return jnp.where(units.health[:, None] > 0, place, jnp.nan)

    def render(self, env_state: MicroBattleState) -> np.ndarray:
        """Draw the map, the units and their shots; see `render.draw`."""
        return draw(self.resolved_scenario, env_state)

    def render_episode(self, env_states: Sequence[MicroBattleState]) -> list[np.ndarray]:
        """Draw the part of the map where units are in any of the states."""
        box = surround(self.resolved_scenario, env_states)
        return [draw(self.resolved_scenario, state, box) for state in env_states]
