"""Evaluation counts exactly one whole episode per copy."""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from envs_jax import TimeStep
from hmasd_jax.rl.evaluate import evaluate, first_episode, play
from hmasd_jax.types import Policy


@dataclass(frozen=True)
class Countdown:
    """Lasts as many steps as its action says, at most 4; pays the number of the step."""

    num_agents: ClassVar[int] = 1
    num_actions: ClassVar[int] = 5
    obs_dim: ClassVar[int] = 1
    state_dim: ClassVar[int] = 1
    max_steps: ClassVar[int] = 4

    def reset(self, key):
        return jnp.int32(0), self._timestep(jnp.int32(0), jnp.bool_(False))

    def step(self, key, env_state, action):
        time = env_state + 1
        return time, self._timestep(time, time >= action[0])

    def _timestep(self, time, terminated):
        return TimeStep(
            obs=time.astype(jnp.float32)[None, None],
            state=time.astype(jnp.float32)[None],
            action_mask=jnp.ones((1, 5), bool),
            reward=time.astype(jnp.float32),
            terminated=terminated,
            truncated=(time >= 4) & ~terminated,
            info={"success": (terminated & (time >= 2)).astype(jnp.float32)},
        )


def _stop_at(steps):
    """A policy under which copy i plays episodes of `steps[i]` steps."""

    def step(memory, timestep, first, key):
        return memory, memory[:, None], ()

    return Policy(lambda batch_shape: jnp.asarray(steps), step)


def test_means_over_the_first_episodes_only():
    # Copies end after 1, 2, 4 and 4 (time limit, asked for 5) steps and then start again:
    #   return  1, 1 + 2 = 3, 10, 10       mean 6
    #   length  1, 2, 4, 4                 mean 2.75
    #   success 0 (too early), 1, 1, 0     mean 0.5
    def run(key):
        return evaluate(Countdown(), _stop_at([1, 2, 4, 5]), key, 4)

    metrics = jax.jit(run)(jax.random.key(0))
    assert_allclose(metrics["return"], 6.0)
    assert_allclose(metrics["length"], 2.75)
    assert_allclose(metrics["success"], 0.5)
    assert set(metrics) == {"return", "length", "success"}


def test_first_episode_includes_its_last_step_and_nothing_after():
    transitions = play(Countdown(), _stop_at([1, 2, 3, 5]), jax.random.key(0), 4)
    expected = [[1, 0, 0, 0], [1, 1, 0, 0], [1, 1, 1, 0], [1, 1, 1, 1]]
    np.testing.assert_array_equal(first_episode(transitions).T, expected)


@pytest.mark.parametrize("shape", [(), (3,)])
def test_evaluation_maps_over_policies(shape):
    # A sweep evaluates each seed, here each policy.
    def run(steps):
        policy = Policy(
            lambda batch_shape: jnp.broadcast_to(steps, batch_shape),
            lambda memory, timestep, first, key: (memory, memory[:, None], ()),
        )
        return evaluate(Countdown(), policy, jax.random.key(0), 2)["length"]

    steps = jnp.arange(1, 4).reshape(3)[: 3 if shape else 1].reshape(shape)
    lengths = (jax.vmap(run) if shape else run)(steps)
    np.testing.assert_array_equal(lengths, steps)
