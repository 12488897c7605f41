"""Unit micro-battles: a stand-in for SMAC's 3m, 2s_vs_1sc and 2m_vs_1z with 0-1 reward.

Each agent commands one unit against enemies that follow a fixed rule. The team is paid 1 once, when
the last enemy dies while one of the agents' units lives. Units, walls, starts, actions, masks and
observations follow SMAC and StarCraft II's data files; the game itself was never run. What is
modelled and what is not: docs/micro_battle.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int

from envs_jax.choices import check_choice
from envs_jax.micro_battle.constants import column, make_roster
from envs_jax.micro_battle.observations import (
    DIRECTIONS,
    FIRST_ATTACK,
    FIRST_MOVE,
    Observation,
    action_mask,
    observe,
    sizes,
)
from envs_jax.micro_battle.physics import LONG_AGO, NOBODY, Orders, Units, tick
from envs_jax.micro_battle.render import ALLIES, draw
from envs_jax.micro_battle.scenarios import JITTER, SCENARIOS, Scenario
from envs_jax.micro_battle.unit_types import Balance
from envs_jax.types import TimeStep

TICKS_PER_STEP = 8


class MicroBattleState(NamedTuple):
    """Simulator state of one episode."""

    units: Units
    """Allies, then enemies."""
    goal: Float[Array, "2 *copies"]
    """Where enemies go; not used in scenarios without goals."""
    last_action: Int[Array, "agents *copies"]
    """-1 before the first step."""
    time: Int[Array, "*copies"]
    """Steps taken."""


@dataclass(frozen=True)
class MicroBattle:
    """The battle; see the module docstring for its rules.

    Actions are SMAC's: 0 no-op (the dead only), 1 stop, 2 to 5 move north (+y), south, east (+x),
    west, and 6 + j attack enemy j. What the mask rules out is treated as stop.

    Raises:
        ValueError: unknown scenario, balance or observation, or a time limit below 1.
    """

    scenario: str | Scenario = "3m"
    """Name in `battle_scenarios.SCENARIOS`, or a scenario of your own."""
    balance: Balance = "multi"
    """Which of the game's two sets of unit data: `multi`, multiplayer games, or `liberty`, the
    campaign that SMAC's maps name as theirs. They differ in stalkers and spine crawlers."""
    observation: Observation = "mappo"
    """Layout of obs and state: `mappo`, of MAPPO's wrapper around SMAC, which HMASD's authors used
    with one state for all agents (3m: 64 and 75), or `smac`, SMAC's own (30 and 48)."""
    time_limit: int | None = None
    """Environment steps of an episode; None takes the scenario's."""

    def __post_init__(self) -> None:
        if isinstance(self.scenario, str) and self.scenario not in SCENARIOS:
            known = ", ".join(SCENARIOS)
            raise ValueError(
                f"scenario {self.scenario!r} is unknown; choose from {known}, or give a Scenario"
            )
        check_choice("balance", self.balance, Balance)
        check_choice("observation", self.observation, Observation)
        if self.time_limit is not None and self.time_limit < 1:
            raise ValueError(f"time_limit must be at least 1 or None, got {self.time_limit}")

    @property
    def layout(self) -> Scenario:
        """The scenario itself, if it was given by name."""
        return SCENARIOS[self.scenario] if isinstance(self.scenario, str) else self.scenario

    @property
    def num_agents(self) -> int:
        """Number of allied units."""
        return len(self.layout.allies)

    @property
    def num_actions(self) -> int:
        """No-op, stop, four moves, and an attack per enemy."""
        return FIRST_ATTACK + len(self.layout.enemies)

    @property
    def obs_dim(self) -> int:
        """Length of an agent's observation vector."""
        return sizes(self.layout, self.observation)[0]

    @property
    def state_dim(self) -> int:
        """Length of the global state vector."""
        return sizes(self.layout, self.observation)[1]

    @property
    def max_steps(self) -> int:
        """Time limit in environment steps."""
        return self.layout.max_steps if self.time_limit is None else self.time_limit

    @property
    def agent_names(self) -> tuple[str, ...]:
        """Names of the agents in pictures."""
        return tuple(f"{spawn.unit} {i + 1}" for i, spawn in enumerate(self.layout.allies))

    @property
    def agent_colors(self) -> tuple[tuple[int, int, int], ...]:
        """Colors of the agents in pictures."""
        return tuple(ALLIES[i % len(ALLIES)] for i in range(self.num_agents))

    def reset(self, key: jax.Array) -> tuple[MicroBattleState, TimeStep]:
        """Place all units up to 0.1 cells off where the scenario has them, in any direction."""
        num_units = self.num_agents + len(self.layout.enemies)
        # Half a word is random enough for a coordinate: one word per unit, and one for the goal.
        return _copies_last(self._begin)(jax.random.bits(key, (num_units + 1,)))

    def step(
        self, key: jax.Array, env_state: MicroBattleState, action: Int[Array, " agents"]
    ) -> tuple[MicroBattleState, TimeStep]:
        """Carry out orders for half a second of game time."""
        luck = jax.random.uniform(key, env_state.units.x.shape)
        return _copies_last(self._advance)(env_state, action, luck)

    def _begin(self, bits: Array) -> tuple[MicroBattleState, TimeStep]:
        """`reset` from random words, copies last."""
        scenario, copies = self.layout, bits.shape[1:]
        roster = make_roster(scenario, self.balance, len(copies))
        fractions = jnp.stack([bits & 0xFFFF, bits >> 16]).astype(jnp.float32) / 2**16
        area, turn = fractions[:, :-1]  # a point of a disc
        angle = 2 * jnp.pi * turn
        jitter = JITTER * jnp.sqrt(area) * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        spawns = (*scenario.allies, *scenario.enemies)
        start = column(np.array([[s.x for s in spawns], [s.y for s in spawns]]), len(copies))
        x, y = start + jnp.where(roster.speed > 0, jitter, 0)  # a building has its fixed place
        ends = column(np.array(scenario.goals or ((0, 0),), np.float32), len(copies))
        zero, nobody = jnp.zeros_like(x), jnp.full(x.shape, NOBODY, jnp.int32)
        units = Units(
            x=x,
            y=y,
            health=zero + roster.max_health,
            shield=zero + roster.max_shield,
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
        return state, self._timestep(state, jnp.zeros(copies, bool))

    def _advance(
        self,
        state: MicroBattleState,
        action: Int[Array, "agents *copies"],
        luck: Float[Array, "units *copies"],
    ) -> tuple[MicroBattleState, TimeStep]:
        """`step` with one random number per unit, copies last."""
        scenario = self.layout
        roster = make_roster(scenario, self.balance, luck.ndim - 1)
        orders = self._read_orders(action_mask(scenario, state.units), action)
        goal = state.goal if scenario.goals else None

        def advance(units: Units, now: Array) -> tuple[Units, None]:
            return tick(roster, scenario.floor, units, orders, goal, luck, now), None

        now = jnp.arange(TICKS_PER_STEP, dtype=jnp.float32)
        units, _ = jax.lax.scan(advance, state.units, now)
        units = units._replace(
            ready=jnp.maximum(units.ready - TICKS_PER_STEP, 0),
            begun=units.begun - TICKS_PER_STEP,
            struck=units.struck - TICKS_PER_STEP,
        )
        after = MicroBattleState(units, state.goal, action.astype(jnp.int32), state.time + 1)
        return after, self._timestep(after, self._won(state.units))

    def _read_orders(
        self, mask: Bool[Array, "agents actions *copies"], action: Int[Array, "agents *copies"]
    ) -> Orders:
        """What actions ask of their units, if it is legal."""
        ordered = [(action == index) & mask[:, index] for index in range(self.num_actions)]
        toward_x = toward_y = jnp.zeros(action.shape)
        for (dx, dy), moves in zip(DIRECTIONS, ordered[FIRST_MOVE:FIRST_ATTACK], strict=True):
            toward_x, toward_y = jnp.where(moves, dx, toward_x), jnp.where(moves, dy, toward_y)
        target = jnp.full(action.shape, NOBODY, jnp.int32)
        for enemy, attacks in enumerate(ordered[FIRST_ATTACK:], start=self.num_agents):
            target = jnp.where(attacks, enemy, target)
        enemies = jnp.zeros((len(self.layout.enemies), *action.shape[1:]))
        return Orders(
            target=jnp.concatenate([target, enemies.astype(jnp.int32)]),
            toward_x=jnp.concatenate([toward_x, enemies]),
            toward_y=jnp.concatenate([toward_y, enemies]),
        )

    def _won(self, units: Units) -> Bool[Array, "*copies"]:
        alive = units.health > 0
        return alive[: self.num_agents].any(0) & ~alive[self.num_agents :].any(0)

    def _timestep(self, state: MicroBattleState, won_before: Bool[Array, "*copies"]) -> TimeStep:
        units = state.units
        roster = make_roster(self.layout, self.balance, units.x.ndim - 1)
        mask = action_mask(self.layout, units)
        obs, global_state = observe(
            self.layout, self.observation, roster, units, state.last_action, mask
        )
        alive = units.health > 0
        allies, enemies = alive[: self.num_agents], alive[self.num_agents :]
        over = ~allies.any(0) | ~enemies.any(0)
        won = self._won(units)
        return TimeStep(
            obs=obs,
            state=global_state,
            action_mask=mask,
            reward=(won & ~won_before).astype(jnp.float32),
            terminated=over,
            truncated=(state.time >= self.max_steps) & ~over,
            info={
                "success": won.astype(jnp.float32),
                "allies_alive": allies.sum(0).astype(jnp.float32),
                "enemies_alive": enemies.sum(0).astype(jnp.float32),
            },
        )

    def render(self, env_state: MicroBattleState) -> np.ndarray:
        """Draw the arena, its units and their shots; see `battle_render.draw`."""
        return draw(self.layout, env_state)


@lru_cache  # so that calls without jit find what they compiled before
def _copies_last(function: Callable) -> Callable:
    """Make `jax.vmap` of `function` call it with the copies axis last in all arrays."""
    batched = custom_vmap(jax.jit(function))

    @batched.def_vmap
    def rule(size, is_batched, *args):
        def move(x, has_copies):
            if has_copies:
                return jnp.moveaxis(x, 0, -1)
            return jnp.broadcast_to(x[..., None], (*x.shape, size))

        out = _copies_last(function)(*jax.tree.map(move, args, tuple(is_batched)))
        out = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), out)
        return out, jax.tree.map(lambda _: True, out)

    return batched
