"""Scripted players of `micro_battle` with full information, and their win rates.

A tactic maps (scene, memory, key) to (actions, memory) for one copy; its memory starts as 0.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs_jax import random_actions
from envs_jax.micro_battle.environment import MicroBattle
from envs_jax.micro_battle.observations import DIRECTIONS, FIRST_ATTACK, FIRST_MOVE, STOP

NORTH, SOUTH, EAST, WEST = range(FIRST_MOVE, FIRST_ATTACK)
LOW = 60.0
"""Points of health and shield at which a stalker needs relief."""


class Scene(NamedTuple):
    """What a tactic may look at; rows are allies, columns enemies."""

    mask: jax.Array
    dx: jax.Array
    """From ally to enemy, as dy; infinitely far if the enemy is dead."""
    dy: jax.Array
    away: jax.Array
    total: jax.Array
    """Health and shield of allies."""
    shield_share: jax.Array
    """Shield of allies as a part of what they start with."""
    enemy_total: jax.Array
    """Of enemies; infinite if dead."""

    @property
    def attackable(self):
        """Whether each ally can attack each enemy, (N, enemies)."""
        return self.mask[:, FIRST_ATTACK:]


def look(env: MicroBattle, start, env_state, mask) -> Scene:
    """Return the battlefield as the players see it."""
    units, n = env_state.units, env.num_agents
    alive = units.health[n:] > 0
    dx = jnp.where(alive, units.x[n:] - units.x[:n, None], jnp.inf)
    dy = jnp.where(alive, units.y[n:] - units.y[:n, None], jnp.inf)
    total = units.health + units.shield
    share = units.shield[:n] / jnp.maximum(start.units.shield[:n], 1)
    enemy_total = jnp.where(alive, total[n:], jnp.inf)
    return Scene(mask, dx, dy, jnp.hypot(dx, dy), total[:n], share, enemy_total)


def random(scene, memory, key):
    """Play a random legal action."""
    return random_actions(key, scene.mask), memory


def attack_else_random(scene, memory, key):
    """A random attack if there is one, else a random action."""
    attacks = jnp.where(scene.attackable, 10.0, 0.0)
    logits = jnp.concatenate([jnp.zeros((len(attacks), FIRST_ATTACK)), attacks], axis=1)
    logits = jnp.where(logits == 10.0, 100.0, logits)
    return jax.random.categorical(key, jnp.where(scene.mask, logits, -jnp.inf)), memory


def approach(scene, enemy):
    """The legal move that brings each ally closest to its `enemy`."""
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
    """Attack the attackable enemy of the least score; without one, stand or walk to the nearest."""
    del key
    enemy = jnp.where(scene.attackable, score(scene), jnp.inf).argmin(1)
    otherwise = approach(scene, scene.away.argmin(1)) if walk else STOP
    return jnp.where(scene.attackable.any(1), FIRST_ATTACK + enemy, otherwise), memory


def hold_random(scene, memory, key):
    """Attack a random enemy; without one in range, stand."""
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
    """Against one enemy: the nearest ally runs if it is closer than 3, the others shoot."""
    del key
    away = jnp.where(scene.mask[:, STOP], scene.away[:, 0], jnp.inf)
    runs = (away == away.min()) & (away < 3)
    enemy = jnp.zeros(len(away), int)
    shoots = jnp.where(scene.attackable[:, 0], FIRST_ATTACK, approach(scene, enemy))
    return jnp.where(runs, flee(scene, enemy), shoots), memory


def swap(scene, memory, key, rest, near=6.0, back=8.7):
    """Against the spine crawler: the first stalker that is low steps out of reach and comes back.

    If they may `rest`, both leave once both are low, until shields are full, and attack again.
    They shoot from within `near`; who steps out comes back from farther than `back`.

    Memory counts: 0 attack, 1 the first is out, 2 attack again, 3 both rest, 4 attack to the end.
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
    """Hide: walk in one direction, or where that is blocked in another."""
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
    """A compiled function of (index in `TACTICS`, share of random actions, key).

    It returns per episode whether it was won, whether time ran out, steps, and what health the
    enemies had left; all (episodes,).
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
