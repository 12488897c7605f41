"""Step E environment copies, with an auto-reset that keeps the true outcome."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Shaped

from envs_jax import Environment, EnvState, TimeStep
from hmasd_jax.types import EnvCarry, Key, Memory, Metrics, StepFn, Transition


def reset(env: Environment, key: Key, num_envs: int) -> EnvCarry:
    """Start `num_envs` episodes."""
    env_state, timestep = jax.vmap(env.reset)(jax.random.split(key, num_envs))
    return EnvCarry(env_state=env_state, timestep=timestep, first=jnp.ones(num_envs, bool))


def unroll(
    env: Environment, step_fn: StepFn, carry: EnvCarry, memory: Memory, key: Key, length: int
) -> tuple[EnvCarry, Memory, Transition]:
    """Act for `length` steps in all copies. A new episode follows one that ended.

    Returns:
        The copies after the last step, the policy's memory, and transitions (length, E, ...).
    """

    def act_and_step(loop, key):
        carry, memory = loop
        key_policy, key_env = jax.random.split(key)
        memory, action, extras = step_fn(memory, carry.timestep, carry.first, key_policy)
        next_carry, outcome = step(env, carry, action, key_env)
        transition = Transition(
            timestep=carry.timestep,
            first=carry.first,
            action=action,
            extras=extras,
            outcome=outcome,
        )
        return (next_carry, memory), transition

    (carry, memory), transitions = jax.lax.scan(
        act_and_step, (carry, memory), jax.random.split(key, length)
    )
    return carry, memory, transitions


def step(
    env: Environment, carry: EnvCarry, action: Int[Array, "E agents"], key: Key
) -> tuple[EnvCarry, TimeStep]:
    """Step all copies. A new episode follows one that ended.

    Returns:
        The copies after the step, reset where done, and the outcome before the reset.
    """
    num_envs = action.shape[0]
    key_step, key_reset = jax.random.split(key)
    keys_step = jax.random.split(key_step, num_envs)
    env_state, outcome = jax.vmap(env.step)(keys_step, carry.env_state, action)
    # Most steps end no episode and need no reset.
    env_state, timestep = jax.lax.cond(
        outcome.done.any(),
        lambda: _restart(env, key_reset, env_state, outcome),
        lambda: (env_state, outcome),
    )
    return EnvCarry(env_state=env_state, timestep=timestep, first=outcome.done), outcome


def _restart(
    env: Environment, key: Key, env_state: EnvState, timestep: TimeStep
) -> tuple[EnvState, TimeStep]:
    """Begin new episodes in the copies that are done, a few at a time, since rarely many are."""
    done = timestep.done
    # Raw key data: JAX's check of key reuse cannot know that each key is used in one batch only.
    key_data = jax.random.key_data(jax.random.split(key, done.size))
    at_once = min(done.size, max(done.size // 32, 8))
    ended = jnp.sort(jnp.where(done, jnp.arange(done.size), done.size))  # others sort last

    def restart_batch(i, reached):
        # The last batch may overlap the one before: those copies restart twice, identically.
        batch = jax.lax.dynamic_slice_in_dim(ended, i * at_once, at_once)
        keys = jax.random.wrap_key_data(key_data[batch], impl=jax.random.key_impl(key))
        fresh = jax.vmap(env.reset)(keys)
        return jax.tree.map(lambda old, new: old.at[batch].set(new, mode="drop"), reached, fresh)

    return jax.lax.fori_loop(0, -(-done.sum() // at_once), restart_batch, (env_state, timestep))


def following(
    x: Shaped[Array, "T *rest"], last: Shaped[Array, "*rest"]
) -> Shaped[Array, "T *rest"]:
    """Shift `x` by one step: each entry's successor in time, with `last` at the end."""
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


def rollout_metrics(outcome: TimeStep) -> Metrics:
    """Summarize a rollout (T, E, ...): mean reward, episodes that ended, sums of their last `info`.

    Sums instead of means let logging pool rollouts with different numbers of episodes.
    """
    final = {k: jnp.where(outcome.done, v, 0.0).sum() for k, v in outcome.info.items()}
    sums = {f"episode_sum/{k}": v for k, v in final.items()}
    episodes = outcome.done.sum().astype(jnp.float32)
    return {"team_reward": outcome.reward.mean(), "episodes": episodes, **sums}
