"""Stepping E environment copies, with auto-reset that keeps the true outcome."""

import jax
import jax.numpy as jnp

from envs_jax import Environment
from hmasd_jax.types import EnvCarry, Key, Memory, StepFn, Transition


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

    def step(loop, key):
        carry, memory = loop
        key_policy, key_env = jax.random.split(key)
        memory, action, extras = step_fn(memory, carry.timestep, carry.first, key_policy)
        following, outcome = _step_and_reset(env, carry, action, key_env)
        transition = Transition(carry.timestep, carry.first, action, extras, outcome)
        return (following, memory), transition

    (carry, memory), transitions = jax.lax.scan(
        step, (carry, memory), jax.random.split(key, length)
    )
    return carry, memory, transitions


def _step_and_reset(env, carry, action, key):
    """Step every copy; return where each stands (reset if done) and the outcome before that."""
    num_envs = action.shape[0]
    key_step, key_reset = jax.random.split(key)
    keys_step = jax.random.split(key_step, num_envs)
    env_state, outcome = jax.vmap(env.step)(keys_step, carry.env_state, action)
    fresh = reset(env, key_reset, num_envs)

    def where_done(new, old):
        done = outcome.done.reshape(num_envs, *(1,) * (new.ndim - 1))
        return jnp.where(done, new, old)

    env_state, timestep = jax.tree.map(
        where_done, (fresh.env_state, fresh.timestep), (env_state, outcome)
    )
    return EnvCarry(env_state, timestep, outcome.done), outcome
