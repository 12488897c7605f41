"""Observations, global state and action masks of `micro_battle`.

Both observations and state have two formats, that of SMAC and that of MAPPO's wrapper around it.
Features follow `get_obs_agent`, `get_state` and `get_avail_agent_actions` of oxwhirl/smac
(starcraft2.py) and of marlbenchmark/on-policy (StarCraft2_Env.py) with its default flags and one
state for all agents. Arrays have units first and copies last, as in `physics`.
"""

from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs_jax.micro_battle.constants import UnitConstants, column
from envs_jax.micro_battle.physics import Units, length
from envs_jax.micro_battle.scenarios import Scenario, is_floor
from envs_jax.micro_battle.unit_types import UNIT_TYPES

Format = Literal["mappo", "smac"]

SIGHT = 9.0
"""Distance in cells below which an agent sees a unit, even through walls."""
ATTACK_RANGE = 6.0
"""Distance in cells up to which an attack is legal. It is not the reach of the weapon."""
DIRECTIONS = np.array([(0, 1), (0, -1), (1, 0), (-1, 0)], np.float32)  # North, south, east, west.
NO_OP, STOP, FIRST_MOVE, FIRST_ATTACK = 0, 1, 2, 6


def unit_kinds(scenario: Scenario) -> tuple[str, ...]:
    """Return the unit types that features tell apart: none if each side has only one type."""
    sides = [{spawn.unit for spawn in side} for side in (scenario.allies, scenario.enemies)]
    return tuple(sorted(sides[0] | sides[1])) if max(map(len, sides)) > 1 else ()


def obs_size(scenario: Scenario, form: Format) -> int:
    """Return the length of an agent's observation."""
    allies, enemies = len(scenario.allies), len(scenario.enemies)
    ally, enemy = _vitals_sizes(scenario)
    moves = len(DIRECTIONS)
    if form == "smac":
        return moves + enemies * (4 + enemy) + (allies - 1) * (4 + ally) + ally
    actions = FIRST_ATTACK + enemies
    return allies * (4 + ally + actions) + enemies * (4 + enemy) + moves + allies


def state_size(scenario: Scenario, form: Format) -> int:
    """Return the length of the global state."""
    allies, enemies = len(scenario.allies), len(scenario.enemies)
    ally, enemy = _vitals_sizes(scenario)
    actions = FIRST_ATTACK + enemies
    blank = actions if form == "mappo" else 0  # Behind the features of each enemy.
    return allies * (3 + ally + actions) + enemies * (2 + enemy + blank)


def action_mask(scenario: Scenario, units: Units) -> Bool[Array, "agents actions *copies"]:
    """Return SMAC's legal actions.

    A dead agent can only do no-op, and a living agent can do anything else. A move is legal if the
    point 1 cell ahead is on the floor. An attack is legal if the enemy lives and is at most 6 cells
    away. Stop is always legal for the living.
    """
    agents = len(scenario.allies)
    x, y = units.x[:agents], units.y[:agents]
    alive = units.health > 0
    moves = [is_floor(scenario.floor, x + dx, y + dy) for dx, dy in DIRECTIONS]
    attacks = [
        alive[enemy] & (length(units.x[enemy] - x, units.y[enemy] - y) <= ATTACK_RANGE)
        for enemy in range(agents, len(alive))
    ]
    rows = [jnp.ones_like(alive[:agents]), *moves, *attacks]
    legal = [row & alive[:agents] for row in rows]
    return jnp.stack([~alive[:agents], *legal], axis=1)


def observe(
    scenario: Scenario,
    form: Format,
    constants: UnitConstants,
    units: Units,
    last_action: Int[Array, "agents *copies"],
    mask: Bool[Array, "agents actions *copies"],
) -> Float[Array, "agents obs *copies"]:
    """Encode the observations.

    That of a dead agent is zero except for its index.

    Args:
        scenario: The scenario.
        form: Format of the observations.
        constants: Constants of the units.
        units: All units.
        last_action: Last action of each agent, -1 at reset.
        mask: Legal actions.
    """
    agents = len(scenario.allies)
    acted = _acted(scenario, last_action)
    dx, dy = units.x - units.x[:agents, None], units.y - units.y[:agents, None]
    away = length(dx, dy)  # (agents, units, *copies)
    alive = units.health > 0
    seen = (away < SIGHT) & alive & alive[:agents, None]
    place = [away / SIGHT, dx / SIGHT, dy / SIGHT]
    blocks = {}
    for side, first in (("allies", seen), ("enemies", mask[:, FIRST_ATTACK:])):
        part = slice(agents) if side == "allies" else slice(agents, None)
        vitals = [v[part] for v in _vitals(scenario, side, constants, units)]
        shape = seen[:, part].shape
        features = [first[:, part] if side == "allies" else first, *(p[:, part] for p in place)]
        features += [jnp.broadcast_to(v, shape) for v in vitals]
        if side == "allies" and form == "mappo":
            features += [jnp.broadcast_to(acted[:, a], shape) for a in range(acted.shape[1])]
        rows = jnp.stack([jnp.where(seen[:, part], f, 0.0) for f in features], axis=2)
        blocks[side] = _flat(_without_self(rows) if side == "allies" else rows)

    here = alive[:agents, None]
    copies = here.shape[2:]
    own = jnp.stack([v[:agents] for v in _vitals(scenario, "allies", constants, units)], axis=1)
    moves = mask[:, FIRST_MOVE:FIRST_ATTACK]
    if form == "smac":
        parts = [moves, blocks["enemies"], blocks["allies"], own * here]
    else:
        at_self = column(np.array([1, 0, 0, 0]), len(copies))  # Visible, distance, dx, dy.
        index = jnp.broadcast_to(column(np.eye(agents), len(copies)), (agents, agents, *copies))
        own = [at_self * here, own * here, acted & here]
        parts = [blocks["allies"], blocks["enemies"], moves, *own, index]
    return jnp.concatenate([part.astype(jnp.float32) for part in parts], axis=1)


def global_state(
    scenario: Scenario,
    form: Format,
    constants: UnitConstants,
    units: Units,
    last_action: Int[Array, "agents *copies"],
) -> Float[Array, "state *copies"]:
    """Encode the global state, for arguments as in `observe`.

    It contains health, cooldown (allies only), centered position, shield and type of every living
    unit, and the last actions. SMAC's format appends the last actions of all agents. The wrapper's
    format puts the last action of each agent behind the features of its unit, and as many zeros
    behind those of each enemy.
    """
    agents = len(scenario.allies)
    acted = _acted(scenario, last_action)
    width, height = scenario.size
    alive = units.health > 0
    x, y = units.x / width - 0.5, units.y / height - 0.5
    sides = []
    for side in ("allies", "enemies"):
        part = slice(agents) if side == "allies" else slice(agents, None)
        health, *rest = _vitals(scenario, side, constants, units)
        cooldown = [jnp.maximum(units.ready, 0) / constants.cooldown_scale] * (side == "allies")
        features = [jnp.where(alive, f, 0.0)[part] for f in (health, *cooldown, x, y, *rest)]
        if form == "mappo":
            blank = jnp.zeros_like(x[part])
            actions = range(acted.shape[1])
            features += [acted[:, a] & alive[part] if side == "allies" else blank for a in actions]
        sides.append(_flat(jnp.stack(features, axis=1)[None])[0])
    if form == "smac":
        sides.append(_flat(acted[None])[0].astype(jnp.float32))
    return jnp.concatenate(sides)


def _acted(
    scenario: Scenario, last_action: Int[Array, "agents *copies"]
) -> Bool[Array, "agents actions *copies"]:
    """Return the last actions as one-hot vectors; zeros at reset."""
    actions = FIRST_ATTACK + len(scenario.enemies)
    return jnp.stack([last_action == action for action in range(actions)], axis=1)


def _vitals_sizes(scenario: Scenario) -> tuple[int, int]:
    """Return the numbers of features that `_vitals` has of an ally and of an enemy."""
    others = 1 + len(unit_kinds(scenario))
    return others + _has_shields(scenario.allies), others + _has_shields(scenario.enemies)


def _vitals(scenario: Scenario, side: str, constants: UnitConstants, units: Units) -> list[Array]:
    """Return health, shield if the side has any, and type: SMAC's features besides the position."""
    vitals = [units.health / constants.max_health]
    if _has_shields(getattr(scenario, side)):
        vitals.append(units.shield / np.maximum(constants.max_shield, 1))
    names = [spawn.unit for spawn in (*scenario.allies, *scenario.enemies)]
    for kind in unit_kinds(scenario):
        is_kind = np.array([name == kind for name in names], np.float32)
        vitals.append(jnp.broadcast_to(column(is_kind, units.x.ndim - 1), units.x.shape))
    return vitals


def _has_shields(spawns) -> bool:
    return any(UNIT_TYPES["multi"][spawn.unit].shield > 0 for spawn in spawns)


def _without_self(rows: Array) -> Array:
    """Remove the diagonal: (agents, agents, ...) to (agents, agents - 1, ...)."""
    agents = len(rows)
    after_self = np.arange(agents - 1) >= np.arange(agents)[:, None]
    after_self = after_self.reshape(after_self.shape + (1,) * (rows.ndim - 2))
    return jnp.where(after_self, rows[:, 1:], rows[:, :-1])


def _flat(rows: Array) -> Array:
    """Flatten (agents, units, features, ...) to (agents, units * features, ...)."""
    return rows.reshape(len(rows), rows.shape[1] * rows.shape[2], *rows.shape[3:])
