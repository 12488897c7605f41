"""Counts of EITI and EDTI, against a slow count with dictionaries, and influence that is known."""

from collections import Counter
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.baselines.eiti import counts, tables
from hmasd_jax.baselines.eiti.config import LocalStateConfig

CONFIG = LocalStateConfig(features=(0, 2), resolution=0.5, table_size=2**16)


def steps(obs, action, next_obs):
    return SimpleNamespace(
        timestep=SimpleNamespace(obs=jnp.float32(obs)), action=jnp.int32(action),
        outcome=SimpleNamespace(obs=jnp.float32(next_obs)),
    )  # fmt: skip


@jax.jit
def explore(obs, action, next_obs):
    keys = counts.make_keys(steps(obs, action, next_obs), CONFIG)
    return counts.count(tables.init(CONFIG.table_size), keys)


def test_counts_equal_those_of_a_table_without_collisions_and_are_never_too_low():
    rng = np.random.default_rng(0)
    numbers = rng.integers(50, size=300)
    truth = np.array([Counter(numbers.tolist())[i] for i in range(60)])
    keys = tables.make_key(7, jnp.arange(60))
    for size, exact in ((2**16, True), (16, False)):
        table = tables.init(size)
        for part in np.split(numbers, 3):  # keys repeat within a call and between calls
            table = tables.add(table, tables.make_key(7, part))
        found = np.asarray(tables.read(table, keys))
        assert (found >= truth).all()
        assert (found == truth).all() == exact
        assert_allclose(table.sum(axis=1), 300)
    assert 0 < tables.load(tables.add(tables.init(100), keys[:5])) <= 0.05


def test_keys_depend_on_the_order_and_number_of_their_parts():
    keys = [tables.make_key(*x) for x in [(1, 2), (2, 1), (1, 2, 0), (0, 1, 2), (1,), (258,)]]
    assert len({int(key) for key in keys}) == len(keys)
    many = tables.make_key(jnp.arange(100)[:, None], jnp.arange(100))
    assert len(np.unique(many)) == 10_000


def test_a_local_state_is_its_features_rounded():
    obs = np.array([[0.1, 5.0, 1.2], [-0.2, 7.0, 0.9], [0.3, 5.0, 1.2], [0.1, 5.0, 1.4]])
    states = np.asarray(counts.local_state(jnp.array(obs), CONFIG))
    assert states[0] == states[1]
    assert len({*states.tolist()}) == 3
    everything = np.asarray(counts.local_state(jnp.array(obs), LocalStateConfig()))
    assert len({*everything.tolist()}) == 4


def test_bonuses_equal_a_slow_count_with_three_agents():
    rng = np.random.default_rng(1)
    shape = (20, 4, 3)
    before, after, action = (rng.integers(n, size=shape) for n in (2, 2, 2))
    _, explored = explore(before[..., None].repeat(3, -1), action, after[..., None].repeat(3, -1))

    visits, alone, pair = Counter(), Counter(), Counter()
    for t in range(20):
        novelty, influence = np.zeros((4, 3)), np.zeros((4, 3, 3))
        of_copy = [list(zip(before[t, e], action[t, e], after[t, e])) for e in range(4)]
        for agents in of_copy:
            for j, (s, a, s_next) in enumerate(agents):
                alone.update([(j, s, a), (j, s, a, s_next)])
                for i, (s_i, a_i, _) in enumerate(agents):
                    pair.update([(j, s, a, i, s_i, a_i), (j, s, a, i, s_i, a_i, s_next)])
        for e, agents in enumerate(of_copy):
            for j, (s, a, s_next) in enumerate(agents):
                novelty[e, j] = 1 / np.sqrt(visits[j, s_next] + 1)
                p = alone[j, s, a, s_next] / alone[j, s, a]
                for i, (s_i, a_i, _) in enumerate(agents):
                    given = (j, s, a, i, s_i, a_i)
                    influence[e, i, j] = (i != j) * (1 - p * pair[given] / pair[*given, s_next])
        for agents in of_copy:
            visits.update((j, s_next) for j, (_, _, s_next) in enumerate(agents))
        assert_allclose(explored.novelty[t], novelty, rtol=1e-6)
        assert_allclose(explored.influence[t], influence, rtol=1e-5, atol=1e-6)
    assert (influence < 0).any()


def test_the_table_is_never_copied():
    table, keys = tables.init(2**18), np.zeros((20, 4, 2), np.uint32)
    keys = counts.StepKeys(*5 * [keys])
    seeds = jax.tree.map(lambda x: np.stack([x, x]), (table, keys))
    for count, inputs in ((counts.count, (table, keys)), (jax.vmap(counts.count), seeds)):
        compiled = jax.jit(count, donate_argnums=0).lower(*inputs).compile()
        assert compiled.memory_analysis().temp_size_in_bytes < table.nbytes / 10


def test_only_the_agent_that_another_depends_on_has_influence():
    """Agent 1 moves to where agent 0 points, so p(s') is 1/2 and 1 once the action is known."""
    rng = np.random.default_rng(2)
    action = rng.integers(2, size=(200, 16, 2))
    after = np.stack([rng.integers(2, size=(200, 16)), action[..., 0]], axis=-1)
    before = np.zeros_like(after)
    _, explored = explore(before[..., None].repeat(3, -1), action, after[..., None].repeat(3, -1))
    late = explored.influence[100:].mean((0, 1))
    assert_allclose(late[0, 1], 0.5, atol=0.01)
    assert_allclose(late[1, 0], 0.0, atol=0.01)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"features": (0, 0)}, "features must hold indices from 0, each once"),
        ({"features": (-1,)}, "features must hold indices from 0"),
        ({"resolution": 0.0}, "resolution must be"),
        ({"table_size": 1}, "table_size must be"),
        ({"table_size": 2**30}, "table_size must be"),
    ],
)
def test_settings_are_checked(fields, message):
    with pytest.raises(ValueError, match=message):
        LocalStateConfig(**fields)
