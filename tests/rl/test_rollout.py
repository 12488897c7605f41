"""Auto-reset, by hand: what the agents see, what the learner is told, who mixes with whom."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_jax import TimeStep
from hmasd_jax.rl import rollout

LIMIT, STOP, GO = 3, 1, 0


class CounterState(NamedTuple):
    time: jax.Array
    name: jax.Array


@dataclass(frozen=True)
class Counter:
    """Shows (time, a number drawn at reset); action 1 terminates, time 3 truncates."""

    num_agents: ClassVar[int] = 1
    num_actions: ClassVar[int] = 2
    obs_dim: ClassVar[int] = 2
    state_dim: ClassVar[int] = 2
    max_steps: ClassVar[int] = LIMIT

    def reset(self, key):
        state = CounterState(jnp.int32(0), jax.random.uniform(key))
        return state, self._timestep(state, jnp.bool_(False))

    def step(self, key, env_state, action):
        state = env_state._replace(time=env_state.time + 1)
        return state, self._timestep(state, action[0] == STOP)

    def _timestep(self, state, terminated):
        shown = jnp.stack([state.time.astype(jnp.float32), state.name])
        return TimeStep(
            obs=shown[None],
            state=shown,
            action_mask=jnp.ones((1, 2), bool),
            reward=10.0 * state.time,
            terminated=terminated,
            truncated=(state.time >= LIMIT) & ~terminated,
            info={"time": shown[0]},
        )


# Copy 0 is stopped by its second action and then by the time limit; copy 1 by the limit twice.
SCRIPT = np.array([[GO, STOP, GO, GO, GO, GO], [GO, GO, GO, GO, GO, GO]])


def _scripted(memory, timestep, first, key):
    """Plays SCRIPT; memory is the number of steps taken."""
    action = jnp.asarray(SCRIPT)[jnp.arange(2), memory][:, None]
    return memory + 1, action, {"first": first}


@pytest.fixture(scope="module")
def six_steps():
    def run(key):
        carry = rollout.reset(Counter(), key, 2)
        memory = jnp.zeros(2, int)
        end, memory, transitions = rollout.unroll(Counter(), _scripted, carry, memory, key, 6)
        return carry, end, memory, transitions

    return jax.tree.map(np.asarray, jax.jit(run)(jax.random.key(0)))


def test_episodes_begin_where_the_last_one_was_done(six_steps):
    _, end, _, transitions = six_steps
    np.testing.assert_array_equal(transitions.first.T, [[1, 0, 1, 0, 0, 1], [1, 0, 0, 1, 0, 0]])
    np.testing.assert_array_equal(end.first, [False, True])
    np.testing.assert_array_equal(transitions.extras["first"], transitions.first)


def test_agents_act_on_the_new_episode_after_a_reset(six_steps):
    _, end, _, transitions = six_steps
    times = transitions.timestep.state[..., 0]
    np.testing.assert_array_equal(times.T, [[0, 1, 0, 1, 2, 0], [0, 1, 2, 0, 1, 2]])
    np.testing.assert_array_equal(end.timestep.state[:, 0], [1, 0])
    np.testing.assert_array_equal(end.env_state.time, [1, 0])


def test_outcomes_are_those_before_the_reset(six_steps):
    transitions = six_steps[3]
    outcome = transitions.outcome
    np.testing.assert_array_equal(outcome.state[..., 0].T, [[1, 2, 1, 2, 3, 1], [1, 2, 3, 1, 2, 3]])
    np.testing.assert_array_equal(outcome.reward, 10 * outcome.state[..., 0])
    np.testing.assert_array_equal(outcome.terminated.T, [[0, 1, 0, 0, 0, 0], [0] * 6])
    np.testing.assert_array_equal(outcome.truncated.T, [[0, 0, 0, 0, 1, 0], [0, 0, 1, 0, 0, 1]])
    # The last thing seen belongs to the episode that ended, not to the one that follows.
    np.testing.assert_array_equal(outcome.state[..., 1], transitions.timestep.state[..., 1])


def test_every_reset_and_every_copy_has_its_own_randomness(six_steps):
    names = six_steps[3].timestep.state[..., 1][six_steps[3].first]
    assert len(names) == 5
    assert len(set(names.tolist())) == 5


@pytest.mark.parametrize("num_done", [0, 1, 8, 9, 20])
def test_of_many_copies_just_those_that_are_done_begin_anew(num_done):
    # As many as fit into one batch of resets, or not; see `rollout._restart`.
    copies = 20
    done = np.random.default_rng(num_done).permutation(copies) < num_done
    carry = rollout.reset(Counter(), jax.random.key(0), copies)
    action = jnp.where(jnp.asarray(done)[:, None], STOP, GO)
    after, outcome = rollout.step(Counter(), carry, action, jax.random.key(1))
    np.testing.assert_array_equal(after.first, done)
    np.testing.assert_array_equal(after.env_state.time, ~done)
    np.testing.assert_array_equal(after.timestep.state[:, 0], ~done)
    np.testing.assert_array_equal(after.env_state.name != carry.env_state.name, done)
    np.testing.assert_array_equal(outcome.state[:, 0], 1)
    assert len(set(after.env_state.name.tolist())) == copies


def test_memory_is_carried_and_actions_are_recorded(six_steps):
    _, _, memory, transitions = six_steps
    np.testing.assert_array_equal(memory, [6, 6])
    np.testing.assert_array_equal(transitions.action[..., 0], SCRIPT.T)


def test_a_rollout_goes_on_where_the_one_before_stopped():
    def run(key):
        carry, memory = rollout.reset(Counter(), key, 2), jnp.zeros(2, int)
        parts = []
        for length in (2, 4):
            carry, memory, part = rollout.unroll(Counter(), _scripted, carry, memory, key, length)
            parts.append(part)
        return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)

    joined = jax.jit(run)(jax.random.key(0))
    np.testing.assert_array_equal(joined.first.T, [[1, 0, 1, 0, 0, 1], [1, 0, 0, 1, 0, 0]])
    times = joined.timestep.state[..., 0]
    np.testing.assert_array_equal(times.T, [[0, 1, 0, 1, 2, 0], [0, 1, 2, 0, 1, 2]])


def test_reset_starts_distinct_episodes_marked_first():
    carry = rollout.reset(Counter(), jax.random.key(0), 4)
    assert carry.first.all()
    np.testing.assert_array_equal(carry.env_state.time, 0)
    assert len(set(carry.env_state.name.tolist())) == 4
