"""Checks that hold for every algorithm, and states to start from."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from hmasd_jax.runs.checkpoint import state_template
from hmasd_jax.types import Learner


def assert_no_key_is_used_twice(algorithm, num_envs):
    """Trace init, update and acting under JAX's check of key reuse."""

    def init_update_act(key):
        key_init, key_act = jax.random.split(key)
        state, _ = algorithm.update(algorithm.init(key_init))
        policy = algorithm.policy(state, greedy=False)
        memory = policy.init((num_envs,))
        return policy.step(memory, state.env.timestep, state.env.first, key_act)

    def reuses(key):
        return jax.random.normal(key) + jax.random.uniform(key)

    with jax.debug_key_reuse(True):
        jax.make_jaxpr(jax.jit(init_update_act))(jax.random.key(0))
        with pytest.raises(jax.errors.KeyReuseError):  # The line above would raise it, too.
            jax.make_jaxpr(jax.jit(reuses))(jax.random.key(0))


def draw_state(algorithm, seed):
    """Draw a train state at random, without a compiled `init`."""
    return draw_like(state_template(algorithm), seed)


def draw_like(shapes, seed):
    """Draw floats at random; those that scale a LayerNorm are around 1, and integers are 0."""
    rng = np.random.default_rng(seed)

    def draw(path, leaf):
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.key(seed)
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            center = float(jax.tree_util.keystr(path).endswith("['scale']"))
            return jnp.asarray(center + 0.35 * rng.normal(size=leaf.shape), leaf.dtype)
        return jnp.zeros(leaf.shape, leaf.dtype)

    return jax.tree_util.tree_map_with_path(draw, shapes)


def lower_all(_, learner, optimizer):
    """Lower all parameters by one step, as the training of an imitation."""
    gradient = jax.tree.map(jnp.ones_like, learner.params)
    updates, opt_state = optimizer.update(gradient, learner.opt_state, learner.params)
    return Learner(optax.apply_updates(learner.params, updates), opt_state), {}
