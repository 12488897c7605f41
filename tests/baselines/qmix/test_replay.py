"""Replay keeps the newest episodes as they were, and draws each with the same probability."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_jax import TimeStep
from hmasd_jax.baselines.qmix import replay as replays
from hmasd_jax.baselines.qmix.replay import Seen, Step
from hmasd_jax.types import Transition

E, L, T = 3, 4, 5  # copies, steps of a rollout, the longest episode


class Recorded(NamedTuple):
    """One episode of a plain list."""

    numbers: list
    """Number of each step; its observation, action and reward are made of it."""
    truncated: bool


def transition(number, first, terminated, truncated):
    """One step of all copies whose contents are `number`; what follows is `number` + 0.5."""

    def seen(x):
        return {
            "obs": jnp.broadcast_to(x[:, None, None], (E, 2, 1)),
            "state": x[:, None],
            "action_mask": jnp.ones((E, 2, 3), bool),
        }

    number = jnp.asarray(number, jnp.float32)
    no = jnp.zeros(E, bool)
    timestep = TimeStep(**seen(number), reward=0 * number, terminated=no, truncated=no, info={})
    outcome = timestep._replace(
        **seen(number + 0.5), reward=-number,
        terminated=jnp.asarray(terminated), truncated=jnp.asarray(truncated),
    )  # fmt: skip
    action = jnp.broadcast_to(number.astype(int)[:, None], (E, 2))
    return Transition(timestep, jnp.asarray(first), action, (), outcome)


def play(rng, rollouts):
    """Rollouts (L, E, ...) of random episodes, and these as a plain list in order of their end."""
    number, age = 1, np.zeros(E, int)
    running: list[list] = [[] for _ in range(E)]
    ended, batches = [], []
    for _ in range(rollouts):
        steps = []
        for _ in range(L):
            numbers = number + np.arange(E)
            number += E
            first, age = age == 0, age + 1
            over = (rng.random(E) < 0.3) | (age == T)
            terminated = over & (rng.random(E) < 0.5)
            steps.append(transition(numbers, first, terminated, over & ~terminated))
            for copy in range(E):
                running[copy].append(int(numbers[copy]))
                if over[copy]:
                    ended.append(Recorded(running[copy], bool(~terminated[copy])))
                    running[copy] = []
            age[over] = 0
        batches.append(jax.tree.map(lambda *x: jnp.stack(x), *steps))
    return batches, ended


def empty(capacity):
    step = jax.tree.map(lambda x: x[0], play(np.random.default_rng(0), 1)[0][0])
    timestep = step.timestep
    seen = Seen(timestep.obs, timestep.state, timestep.action_mask)
    example = Step(seen, step.action, timestep.reward, timestep.terminated)
    return replays.init(example, capacity, T, L)


@pytest.mark.parametrize("bootstrap", [False, True])
@pytest.mark.parametrize("capacity", [2, 7, 30])
def test_the_newest_episodes_come_back_as_they_were(capacity, bootstrap):
    add = jax.jit(partial(replays.add, bootstrap_truncation=bootstrap))
    draw = jax.jit(replays.sample, static_argnums=(2, 3))
    batches, ended = play(np.random.default_rng(capacity), 20)
    replay, count = empty(capacity), 0
    rows = len(replay.steps.reward)
    for batch in batches:
        replay = add(replay, batch)
        count += int(batch.outcome.done.sum())
        newest = ended[max(count - capacity, 0) : count]
        if len(newest) < capacity:
            continue
        episodes = draw(replay, jax.random.key(count), capacity, T)
        drawn = []
        for b in range(capacity):
            length = int(episodes.valid[:, b].sum())
            np.testing.assert_array_equal(episodes.valid[:, b], np.arange(T) < length)
            number = episodes.seen.state[:length, b, 0]
            np.testing.assert_array_equal(episodes.seen.obs[:length, b, 1, 0], number)
            np.testing.assert_array_equal(episodes.action[:length, b, 0], number)
            np.testing.assert_array_equal(episodes.reward[:length, b], -number)
            # After the last step comes its true outcome, not the next episode.
            assert episodes.seen.state[length, b, 0] == number[-1] + 0.5
            assert not episodes.terminated[: length - 1, b].any()
            truncated = not episodes.terminated[length - 1, b]
            drawn.append(Recorded(number.astype(int).tolist(), truncated))
        expected = [x if bootstrap else x._replace(truncated=False) for x in newest]
        assert sorted(drawn) == sorted(expected)
    assert int(replay.written) > rows or capacity == 30  # the ring wrapped around


def test_more_episodes_than_entries_can_end_in_one_rollout():
    no, yes = np.zeros(E, bool), np.ones(E, bool)
    steps = [transition(np.arange(E) + E * i, yes, yes, no) for i in range(L)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *steps)
    replay = replays.add(empty(2), batch, bootstrap_truncation=False)
    episodes = replays.sample(replay, jax.random.key(0), 2, T)
    assert sorted(episodes.seen.state[0, :, 0].tolist()) == [L * E - 2, L * E - 1]


def test_batches_hold_different_episodes_and_each_has_the_same_chance():
    batches, ended = play(np.random.default_rng(1), 3)
    replay = empty(30)
    for batch in batches:
        replay = replays.add(replay, batch, bootstrap_truncation=False)
    keys = jax.random.split(jax.random.key(0), 2000)
    draw = jax.jit(jax.vmap(lambda key: replays.sample(replay, key, 4, T).seen.state[0, :, 0]))
    first = np.asarray(draw(keys))
    assert all(len(set(row)) == 4 for row in first)
    names, counts = np.unique(first, return_counts=True)
    assert sorted(names) == sorted(episode.numbers[0] for episode in ended)
    expected = 2000 * 4 / len(ended)
    assert abs(counts - expected).max() < 5 * np.sqrt(expected)
