"""Evaluation: a fixed number of whole episodes, in a fixed number of steps, inside jit."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from envs_jax import Environment
from hmasd_jax.rl import rollout
from hmasd_jax.types import Key, Metrics, Policy, Transition


def evaluate(env: Environment, policy: Policy, key: Key, num_episodes: int) -> Metrics:
    """Play one episode in each of `num_episodes` copies.

    Returns:
        Means over the episodes: `return` (undiscounted), `length` in environment steps, and every
        key of the environment's `info` at the last step of the episode, e.g. `success`.
    """
    transitions = play(env, policy, key, num_episodes)
    counted = first_episode(transitions)
    outcome = transitions.outcome

    def at_end(x: Float[Array, "T E"]) -> Float[Array, ""]:
        return jnp.where(counted & outcome.done, x, 0.0).sum(0).mean()

    own = {
        "return": jnp.where(counted, outcome.reward, 0.0).sum(0).mean(),
        "length": counted.sum(0).astype(jnp.float32).mean(),
    }
    return own | {name: at_end(value) for name, value in outcome.info.items() if name not in own}


def play(env: Environment, policy: Policy, key: Key, num_episodes: int) -> Transition:
    """Return transitions (max_steps, num_episodes, ...) with one whole episode in each copy.

    A copy that ends early begins another episode, which `first_episode` leaves out.
    """
    key_reset, key_play = jax.random.split(key)
    carry = rollout.reset(env, key_reset, num_episodes)
    memory = policy.init((num_episodes,))
    return rollout.unroll(env, policy.step, carry, memory, key_play, env.max_steps)[2]


def first_episode(transitions: Transition) -> Array:
    """Mark the steps (T, E) of each copy's first episode, including its last step."""
    done = transitions.outcome.done
    return jnp.cumsum(done, axis=0) - done == 0
