"""Replay of whole episodes: the newest steps of all copies in a ring, and a table of episodes.

Axes: W steps in the ring, E environment copies, C episodes in the table, L steps of a rollout,
T the longest episode, B episodes of a batch.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hmasd_jax.types import Key, Transition


class Seen(NamedTuple):
    """Inputs of agents and mixer at a time step."""

    obs: Float[Array, "*batch N obs"]
    state: Float[Array, "*batch state"]
    action_mask: Bool[Array, "*batch N actions"]


class Step(NamedTuple):
    """One step of one copy."""

    seen: Seen
    """Inputs before the action."""
    action: Int[Array, "*batch N"]
    reward: Float[Array, "*batch"]
    terminated: Bool[Array, "*batch"]
    """True if values count as 0 after this step."""


class Replay(NamedTuple):
    """The newest steps of all copies and the newest episodes that ended."""

    steps: Step
    """Ring of (W, E, ...), one row per time."""
    written: Int[Array, ""]
    """Rows written so far."""
    begun: Int[Array, " E"]
    """Row number at which the running episode of each copy begins."""
    ended: Int[Array, ""]
    """Episodes that have ended so far. Number i is in entry i mod C of the table."""
    start: Int[Array, " C"]
    """Row number at which an episode begins."""
    length: Int[Array, " C"]
    copy: Int[Array, " C"]
    final: Seen
    """Inputs after the last step of an episode, (C, ...)."""


class Episodes(NamedTuple):
    """B episodes, padded with steps of later episodes. Time comes first."""

    seen: Seen
    """Inputs at every step and after the last, (T + 1, B, ...)."""
    action: Int[Array, "T B N"]
    reward: Float[Array, "T B"]
    terminated: Bool[Array, "T B"]
    valid: Bool[Array, "T B"]
    """True at the steps of the episode, False at the padding."""

    @property
    def longest(self) -> Int[Array, ""]:
        """Length of the longest episode."""
        return self.valid.sum(axis=0).max()


def init(step: Step, capacity: int, max_steps: int, rollout_length: int) -> Replay:
    """Return an empty replay.

    Args:
        step: One step of all copies (E, ...), for shapes and dtypes.
        capacity: C, the episodes that can be drawn.
        max_steps: T, the longest episode.
        rollout_length: L, the steps that `add` receives.
    """
    num_envs = step.reward.shape[0]
    # The C newest episodes began at most so many rows ago, even if all of them are long. One may
    # run across each end of this span, and C others end after one that began before it.
    rows = (-(-capacity // num_envs) + 3) * max_steps + rollout_length
    rows = -(-rows // rollout_length) * rollout_length  # A rollout never wraps around.

    def zeros(x: Array, *axes: int) -> Array:
        return jnp.zeros((*axes, *x.shape), x.dtype)

    def per_episode() -> Array:
        return jnp.zeros(capacity, jnp.int32)

    return Replay(
        steps=jax.tree.map(lambda x: zeros(x, rows), step),
        written=jnp.int32(0),
        begun=jnp.zeros(num_envs, jnp.int32),
        ended=jnp.int32(0),
        start=per_episode(),
        length=per_episode(),
        copy=per_episode(),
        final=jax.tree.map(lambda x: zeros(x[0], capacity), step.seen),
    )


def add(replay: Replay, transitions: Transition, bootstrap_truncation: bool) -> Replay:
    """Append a rollout (L, E, ...), and enter the episodes that ended in it into the table."""
    outcome, capacity = transitions.outcome, replay.start.size
    length, num_envs = outcome.done.shape
    timestep = transitions.timestep
    steps = Step(
        seen=Seen(timestep.obs, timestep.state, timestep.action_mask),
        action=transitions.action,
        reward=outcome.reward,
        terminated=outcome.terminated if bootstrap_truncation else outcome.done,
    )
    row = replay.written % len(replay.steps.reward)

    def write(ring: Array, new: Array) -> Array:
        return jax.lax.dynamic_update_slice_in_dim(ring, new, row, axis=0)

    now = replay.written + jnp.arange(length)[:, None]
    start = jax.lax.cummax(jnp.where(transitions.first, now, replay.begun))
    done = outcome.done.reshape(-1)
    number = jnp.cumsum(done) - 1  # among the episodes that ended in this rollout
    is_new = done & (number >= done.sum() - capacity)
    # Entry C does not exist. It receives what is not to be kept.
    entry = jnp.where(is_new, (replay.ended + number) % capacity, capacity)

    def enter(table: Array, new: Array) -> Array:
        return table.at[entry].set(new.reshape(-1, *table.shape[1:]), mode="drop")

    copies = jnp.broadcast_to(jnp.arange(num_envs), start.shape)
    final = Seen(outcome.obs, outcome.state, outcome.action_mask)
    return Replay(
        steps=jax.tree.map(write, replay.steps, steps),
        written=replay.written + length,
        begun=start[-1],
        ended=replay.ended + done.sum(),
        start=enter(replay.start, start),
        length=enter(replay.length, now + 1 - start),
        copy=enter(replay.copy, copies),
        final=jax.tree.map(enter, replay.final, final),
    )


def sample(replay: Replay, key: Key, batch_size: int, max_steps: int) -> Episodes:
    """Draw different episodes, each with the same probability.

    At least `batch_size` episodes must have ended.
    """
    capacity = replay.start.size
    filled = jnp.arange(capacity) < replay.ended
    order = jnp.where(filled, jax.random.uniform(key, (capacity,)), -1.0)
    chosen = jax.lax.top_k(order, batch_size)[1]
    start, length, copy, final = jax.tree.map(
        lambda x: x[chosen], (replay.start, replay.length, replay.copy, replay.final)
    )
    time = jnp.arange(max_steps + 1)[:, None]
    rows = (start + time) % len(replay.steps.reward)
    steps = jax.tree.map(lambda x: x[rows, copy], replay.steps)
    is_final = time == length

    def close(x: Array, last: Array) -> Array:
        return jnp.where(is_final.reshape(*is_final.shape, *[1] * (x.ndim - 2)), last, x)

    return Episodes(
        seen=jax.tree.map(close, steps.seen, final),
        action=steps.action[:-1],
        reward=steps.reward[:-1],
        terminated=steps.terminated[:-1],
        valid=(time < length)[:-1],
    )
