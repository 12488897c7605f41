"""Hand-written tactics for `micro_battle` with full information, and a player of them.

A tactic maps (scene, memory, key) to (actions, memory) for one environment copy; its memory starts
at 0.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from envs_jax import random_actions
from envs_jax.micro_battle import MicroBattle
from envs_jax.micro_battle.observations import DIRECTIONS, FIRST_ATTACK, FIRST_MOVE, STOP

NORTH, SOUTH, EAST, WEST = range(FIRST_MOVE, FIRST_ATTACK)
LOW = 60.0
"""Points of health and shield at which a stalker needs relief."""


class Scene(NamedTuple):
    """View of one battle that tactics decide on; the axis M counts enemies."""

    mask: Bool[Array, "N actions"]
    """Legal actions."""
    dx: Float[Array, "N M"]
    """Cells east from ally to enemy; infinite if the enemy is dead."""
    dy: Float[Array, "N M"]
    """Cells north from ally to enemy; infinite if the enemy is dead."""
    away: Float[Array, "N M"]
    """Distance from ally to enemy in cells; infinite if the enemy is dead."""
    total: Float[Array, " N"]
    """Health plus shield of each ally."""
    shield_share: Float[Array, " N"]
    """Shield of each ally as a fraction of its shield at the start."""
    enemy_total: Float[Array, " M"]
    """Health plus shield of each enemy; infinite if dead."""

    @property
    def attackable(self) -> Bool[Array, "N M"]:
        """True where an ally can attack an enemy."""
        return self.mask[:, FIRST_ATTACK:]


def look(env: MicroBattle, start, env_state, mask) -> Scene:
    """Return the scene of `env_state`, given the state at the `start` of the battle."""
    units, n = env_state.units, env.num_agents
    alive = units.health[n:] > 0
    dx = jnp.where(alive, units.x[n:] - units.x[:n, None], jnp.inf)
    dy = jnp.where(alive, units.y[n:] - units.y[:n, None], jnp.inf)
    total = units.health + units.shield
    share = units.shield[:n] / jnp.maximum(start.units.shield[:n], 1)
    enemy_total = jnp.where(alive, total[n:], jnp.inf)
    return Scene(
        mask=mask,
        dx=dx,
        dy=dy,
        away=jnp.hypot(dx, dy),
        total=total[:n],
        shield_share=share,
        enemy_total=enemy_total,
    )


def random(scene, memory, key):
    """Play a random legal action."""
    return random_actions(key, scene.mask), memory


def attack_else_random(scene, memory, key):
    """Play a random attack if there is one, else a random legal action."""
    attacks = jnp.where(scene.attackable, 100.0, 0.0)  # e^100 times as likely as anything else
    logits = jnp.concatenate([jnp.zeros((len(attacks), FIRST_ATTACK)), attacks], axis=1)
    return jax.random.categorical(key, jnp.where(scene.mask, logits, -jnp.inf)), memory


def approach(scene, enemy):
    """Return the legal move that takes each ally closest to its `enemy`, an index per ally."""
    return _best_move(scene, enemy, farthest=False)


def flee(scene, enemy):
    """Return the legal move that takes each ally farthest from its `enemy`."""
    return _best_move(scene, enemy, farthest=True)


def _best_move(scene, enemy, farthest):
    dx = jnp.take_along_axis(scene.dx, enemy[:, None], 1)
    dy = jnp.take_along_axis(scene.dy, enemy[:, None], 1)
    after = jnp.hypot(dx - DIRECTIONS[:, 0], dy - DIRECTIONS[:, 1])
    legal = scene.mask[:, FIRST_MOVE:FIRST_ATTACK]
    if farthest:
        return FIRST_MOVE + jnp.where(legal, after, -jnp.inf).argmax(1)
    return FIRST_MOVE + jnp.where(legal, after, jnp.inf).argmin(1)


def hold(scene, memory, key, score, walk=False):
    """Attack the enemy in range with the lowest score.

    With no enemy in range, stop, or walk to the nearest if `walk`.
    """
    del key
    enemy = jnp.where(scene.attackable, score(scene), jnp.inf).argmin(1)
    otherwise = approach(scene, scene.away.argmin(1)) if walk else STOP
    return jnp.where(scene.attackable.any(1), FIRST_ATTACK + enemy, otherwise), memory


def hold_random(scene, memory, key):
    """Attack a random enemy in range; stop if there is none."""
    chance = jax.random.uniform(key, scene.away.shape)
    return hold(scene, memory, key, lambda scene: chance)


def _from_middle(count):
    return abs(jnp.arange(count) - count // 2)


hold_nearest = partial(hold, score=lambda scene: scene.away)
hold_weakest = partial(hold, score=lambda scene: scene.enemy_total)
walk_nearest = partial(hold, score=lambda scene: scene.away, walk=True)
advance_first = partial(hold, score=lambda scene: jnp.arange(scene.away.shape[1]), walk=True)
advance_middle = partial(hold, score=lambda scene: _from_middle(scene.away.shape[1]), walk=True)


def alternate(scene, memory, key):
    """Kite one enemy: the nearest ally runs if closer than 3 cells, the others attack."""
    del key
    away = jnp.where(scene.mask[:, STOP], scene.away[:, 0], jnp.inf)
    runs = (away == away.min()) & (away < 3)
    enemy = jnp.zeros(len(away), int)
    shoots = jnp.where(scene.attackable[:, 0], FIRST_ATTACK, approach(scene, enemy))
    return jnp.where(runs, flee(scene, enemy), shoots), memory


def swap(scene, memory, key, rest, near=6.0, back=8.7):
    """Fight the spine crawler: the first stalker to run low steps out of reach and returns.

    If they may `rest`, both leave once both are low, wait until their shields are full, and attack
    again. They attack from within `near` cells. A stalker that steps out returns once it is farther
    away than `back` cells.

    The memory is the phase: 0 attack, 1 the weaker is out, 2 attack again, 3 both rest, 4 attack to
    the end.
    """
    del key
    away, low = scene.away[:, 0], scene.total <= LOW
    first = scene.total.argmin()
    memory = jnp.where((memory == 0) & low.any(), 1, memory)
    memory = jnp.where((memory == 1) & (away[first] > back), 2, memory)
    memory = jnp.where((memory <= 2) & low.all() & rest, 3, memory)
    memory = jnp.where((memory == 3) & (scene.shield_share >= 1).all(), 4, memory)
    enemy = jnp.zeros(len(away), int)
    leaves = ((memory == 1) & (jnp.arange(len(away)) == first)) | (memory == 3)
    may_shoot = scene.attackable[:, 0] & (away <= near)
    shoots = jnp.where(may_shoot, FIRST_ATTACK, approach(scene, enemy))
    return jnp.where(leaves, jnp.where(away > 9.2, STOP, flee(scene, enemy)), shoots), memory


def go(scene, memory, key, first, second):
    """Hide: walk in direction `first`, or in direction `second` where that is blocked."""
    del key
    can = scene.mask[:, first], scene.mask[:, second]
    return jnp.where(can[0], first, jnp.where(can[1], second, STOP)), memory


TACTICS = {
    "random": random,
    "attack else random": attack_else_random,
    "walk, nearest": walk_nearest,
    "hold, nearest": hold_nearest,
    "hold, random target": hold_random,
    "hold, weakest": hold_weakest,
    "advance, first": advance_first,
    "advance, middle first": advance_middle,
    "alternate": alternate,
    "swap": partial(swap, rest=False, near=5.5, back=8.5),
    "swap and rest": partial(swap, rest=True),
    "hide in the corner": partial(go, first=SOUTH, second=WEST),
    "hide at the bottom": partial(go, first=SOUTH, second=STOP),
}


def make_play(env: MicroBattle, episodes: int):
    """Compile a player of `TACTICS`.

    Returns:
        A function `play(tactic, noise=0.0, seed=0)`: `tactic` is a name in `TACTICS`, and each
        action is replaced by a random legal one with probability `noise`. It returns four arrays
        (episodes,): True for a victory, True for running out of time, steps, and the health that
        the enemies had left.
    """

    @jax.jit
    def play(tactic, noise, key):
        key_reset, key_play = jax.random.split(key)
        start, timestep = jax.vmap(env.reset)(jax.random.split(key_reset, episodes))

        def act(start, env_state, mask, memory, key):
            key_act, key_noise, key_random = jax.random.split(key, 3)
            scene = look(env, start, env_state, mask)
            action, memory = jax.lax.switch(tactic, list(TACTICS.values()), scene, memory, key_act)
            noisy = jax.random.uniform(key_noise, action.shape) < noise
            action = jnp.where(noisy, random(scene, memory, key_random)[0], action)
            return jnp.where(mask[:, STOP], action, 0).astype(jnp.int32), memory

        def step(carry, key):
            env_state, mask, memory, over, left = carry
            keys = jax.random.split(key, (2, episodes))
            action, memory = jax.vmap(act)(start, env_state, mask, memory, keys[0])
            env_state, timestep = jax.vmap(env.step)(keys[1], env_state, action)
            won, late = (timestep.reward > 0) & ~over, timestep.truncated & ~over
            left = jnp.where(over, left, env_state.units.health[:, env.num_agents :].sum(1))
            carry = env_state, timestep.action_mask, memory, over | timestep.done, left
            return carry, (won, late, ~over)

        nothing = [jnp.zeros(episodes, dtype) for dtype in (int, bool, float)]
        carry, (won, late, active) = jax.lax.scan(
            step,
            (start, timestep.action_mask, *nothing),
            jax.random.split(key_play, env.max_steps),
        )
        return won.any(0), late.any(0), active.sum(0), carry[-1]

    names = list(TACTICS)
    return lambda tactic, noise=0.0, seed=0: play(names.index(tactic), noise, jax.random.key(seed))
