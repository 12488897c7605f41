"""Stepping E environment copies, with auto-reset that keeps the true outcome."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Shaped

from envs_jax import Environment, EnvState, TimeStep
from hmasd_jax.types import EnvCarry, Key, Memory, Metrics, StepFn, Transition


def reset(env: Environment, key: Key, num_envs: int) -> EnvCarry:
    """Start `num_envs` episodes."""
    env_state, timestep = jax.vmap(env.reset)(jax.random.split(key, num_envs))
    return EnvCarry(env_state, timestep, jnp.ones(num_envs, bool))


def unroll(
    env: Environment, step_fn: StepFn, carry: EnvCarry, memory: Memory, key: Key, length: int
) -> tuple[EnvCarry, Memory, Transition]:
    """Act for `length` steps in all copies; an ended episode is followed by a new one.

    Returns:
        Where the copies stand afterwards, the policy's memory, and transitions (length, E, ...).
    """

    def act_and_step(loop, key):
        carry, memory = loop
        key_policy, key_env = jax.random.split(key)
        memory, action, extras = step_fn(memory, carry.timestep, carry.first, key_policy)
        following, outcome = step(env, carry, action, key_env)
        transition = Transition(carry.timestep, carry.first, action, extras, outcome)
        return (following, memory), transition

    (carry, memory), transitions = jax.lax.scan(
        act_and_step, (carry, memory), jax.random.split(key, length)
    )
    return carry, memory, transitions


def step(
    env: Environment, carry: EnvCarry, action: Int[Array, "E agents"], key: Key
) -> tuple[EnvCarry, TimeStep]:
    """Step all copies; an ended episode is followed by a new one.

    Returns:
        Where the copies stand afterwards, reset if done, and the outcome before that.
    """
    num_envs = action.shape[0]
    key_step, key_reset = jax.random.split(key)
    keys_step = jax.random.split(key_step, num_envs)
    env_state, outcome = jax.vmap(env.step)(keys_step, carry.env_state, action)
    # Most steps end no episode, and need no reset prepared.
    env_state, timestep = jax.lax.cond(
        outcome.done.any(),
        lambda: _restart(env, key_reset, env_state, outcome),
        lambda: (env_state, outcome),
    )
    return EnvCarry(env_state, timestep, outcome.done), outcome


def _restart(
    env: Environment, key: Key, env_state: EnvState, timestep: TimeStep
) -> tuple[EnvState, TimeStep]:
    """Begin new episodes in the copies that are done, a few at a time: seldom are many done."""
    done = timestep.done
    # As data: JAX's check for keys used twice cannot know that each is used in one batch only.
    key_data = jax.random.key_data(jax.random.split(key, done.size))
    at_once = min(done.size, max(done.size // 32, 8))
    ended = jnp.sort(jnp.where(done, jnp.arange(done.size), done.size))  # the others stand last

    def restart_batch(i, reached):
        # At the end of `ended` it overlaps the batch before: the same copies restart alike twice.
        batch = jax.lax.dynamic_slice_in_dim(ended, i * at_once, at_once)
        keys = jax.random.wrap_key_data(key_data[batch], impl=jax.random.key_impl(key))
        fresh = jax.vmap(env.reset)(keys)
        return jax.tree.map(lambda old, new: old.at[batch].set(new, mode="drop"), reached, fresh)

    return jax.lax.fori_loop(0, -(-done.sum() // at_once), restart_batch, (env_state, timestep))


def following(
    x: Shaped[Array, "T *rest"], last: Shaped[Array, "*rest"]
) -> Shaped[Array, "T *rest"]:
    """What follows each entry of `x` in time, given what follows the last."""
    return jnp.concatenate([x[1:], last[None]])


def flatten(tree):
    """Merge the first two axes of all arrays, (T, E, ...) -> (T E, ...): one sample per step."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), tree)


def cut(tree, length: int):
    """Cut all arrays into sequences of L = `length`, (T, E, ...) -> (S, L, ...), S = T / L * E."""

    def cut_array(x):
        x = x.reshape(-1, length, *x.shape[1:]).swapaxes(1, 2)
        return x.reshape(-1, length, *x.shape[3:])

    return jax.tree.map(cut_array, tree)


def episode_metrics(outcome: TimeStep) -> Metrics:
    """Number of episodes that ended in a rollout (T, E, ...), and sums of their final `info`.

    Sums rather than means, so that logging can pool rollouts without weighing them wrongly.
    """
    final = {k: jnp.where(outcome.done, v, 0.0).sum() for k, v in outcome.info.items()}
    sums = {f"episode_sum/{k}": v for k, v in final.items()}
    return {"episodes": outcome.done.sum().astype(jnp.float32), **sums}
