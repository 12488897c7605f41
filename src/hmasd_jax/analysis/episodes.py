"""Whole episodes of a policy as arrays. Axes: E episodes, T = `max_steps`, N agents."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from envs_jax import Environment, EnvState, TimeStep
from hmasd_jax.types import Key, Policy


class Played(NamedTuple):
    """E episodes, each from its reset on. Values after the end of an episode are meaningless."""

    env_states: EnvState
    """Simulator states (E, T + 1, ...), the first one included."""
    timesteps: TimeStep
    """Time steps (E, T + 1, ...)."""
    actions: Int[Array, "E T N"]
    extras: Any
    """Extras of the policy (E, T, ...), e.g. the skills in use."""

    @property
    def counted(self) -> Bool[Array, "E T"]:
        """True for the steps of each episode, its last one included."""
        done = self.timesteps.done[:, 1:]
        return jnp.cumsum(done, axis=1) - done == 0


class Episode(NamedTuple):
    """One episode of T steps, cut at its end."""

    env_states: list[Any]
    """T + 1 unbatched simulator states, including the first and the last."""
    skills: np.ndarray | None
    """Z, z^1, .., z^N at every step, (T, 1 + N); None for policies without skills."""
    rewards: np.ndarray
    """Team reward of every step, (T,)."""
    success: bool | None
    """True if the episode ended in success; None if the environment has no success."""


class Loop(NamedTuple):
    """Episodes on their way: E copies between two steps."""

    env_states: EnvState
    timesteps: TimeStep
    memory: Any
    """Memory of the policy."""
    first: Bool[Array, " E"]
    """True before the first step."""


def start(env: Environment, policy: Policy, keys: Key) -> Loop:
    """Reset one copy per key."""
    env_states, timesteps = jax.vmap(env.reset)(keys)
    return Loop(env_states, timesteps, policy.init((len(keys),)), jnp.ones(len(keys), bool))


def advance(env: Environment, policy: Policy, loop: Loop, keys: Key) -> tuple[Loop, Played]:
    """Play steps without a reset at the end of an episode.

    Args:
        env: Environment.
        policy: Policy that acts.
        loop: Copies to continue from.
        keys: One key per step and copy, (T, E).

    Returns:
        The copies after T steps, and the steps, which begin with the states of `loop`.
    """

    def step(loop: Loop, keys: Key) -> tuple[Loop, tuple]:
        split = jax.vmap(jax.random.split)(keys)
        memory, actions, extras = policy.step(loop.memory, loop.timesteps, loop.first, split[0, 0])
        after = jax.vmap(env.step)(split[:, 1], loop.env_states, actions)
        return Loop(*after, memory, jnp.zeros_like(loop.first)), (*after, actions, extras)

    last, (env_states, timesteps, *chosen) = jax.lax.scan(step, loop, keys)
    before = (loop.env_states, loop.timesteps)
    visited = jax.tree.map(
        lambda x, xs: jnp.concatenate([x[None], xs]), before, (env_states, timesteps)
    )
    return last, Played(*jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), (*visited, *chosen)))


def play(env: Environment, policy: Policy, keys: Key) -> Played:
    """Play one episode per key, without a reset at its end. It can be called inside jit.

    All episodes act in one batch: a coordinator that is due in all of them runs once.
    """

    @jax.jit
    def run(keys: Key) -> Played:
        key_reset, key_steps = jax.vmap(jax.random.split, out_axes=1)(keys)
        step_keys = jax.vmap(lambda key: jax.random.split(key, env.max_steps), out_axes=1)
        return advance(env, policy, start(env, policy, key_reset), step_keys(key_steps))[1]

    return run(keys)


def record(env: Environment, policy: Policy, keys: Key) -> list[Episode]:
    """Play one episode per key and cut it at its end."""
    return cut(env, jax.device_get(play(env, policy, keys)))


def cut(env: Environment, played: Played) -> list[Episode]:
    """Cut episodes, as NumPy arrays, at their ends."""
    timesteps = played.timesteps
    skills = skills_of(env, played.extras)
    episodes = []
    for index, length in enumerate(timesteps.done.argmax(axis=1)):
        success = timesteps.info.get("success")
        episodes.append(
            Episode(
                env_states=[
                    jax.tree.map(lambda x, i=index, t=t: x[i, t], played.env_states)
                    for t in range(length + 1)
                ],
                skills=None if skills is None else skills[index, :length],
                rewards=np.asarray(timesteps.reward[index, 1 : length + 1]),
                success=None if success is None else bool(success[index, length] > 0),
            )
        )
    return episodes


def skills_of(env: Environment, extras: Any) -> Any:
    """Return the skills (E, T, 1 + N) in the extras of a policy, or None if it has none."""
    has_skills = getattr(extras, "shape", ())[2:] == (1 + env.num_agents,)
    return extras if has_skills else None
