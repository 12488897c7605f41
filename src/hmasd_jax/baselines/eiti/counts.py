"""Visits and transitions of local states, counted over all of training.

Agents are indexed by i, which acts, and j, whose transition is counted. s, a and s' are local
state, action and next local state. The authors count displacements of j instead of s'_j, which is
the same where s_j is given. They leave out the first step of an episode, which is counted here.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32

from hmasd_jax.baselines.eiti import tables
from hmasd_jax.baselines.eiti.config import LocalStateConfig
from hmasd_jax.baselines.eiti.tables import Table, make_key
from hmasd_jax.types import Transition

VISIT, ALONE, GIVEN_OTHER = range(3)
"""First word of each kind of key, so that no two kinds have a key in common."""


class Explored(NamedTuple):
    """Novelty and influence at each step of a rollout, by the counts."""

    novelty: Float[Array, "T E N"]
    """1 / sqrt(visits + 1) of the local state that each agent reaches, without this visit."""
    influence: Float[Array, "T E N N"]
    """Influence of agent i on the transition of agent j, at [..., i, j]; 0 on the diagonal."""


class StepKeys(NamedTuple):
    """Keys of T steps."""

    visit: UInt32[Array, "T E N"]
    """i, s'_i."""
    alone: UInt32[Array, "T E N"]
    """j, s_j, a_j."""
    alone_next: UInt32[Array, "T E N"]
    """The same with s'_j."""
    given_other: UInt32[Array, "T E pairs"]
    """j, s_j, a_j, i, s_i, a_i, for every ordered pair of agents."""
    given_other_next: UInt32[Array, "T E pairs"]
    """The same with s'_j."""


def local_state(
    obs: Float[Array, "*batch N obs"], config: LocalStateConfig
) -> UInt32[Array, "*batch N"]:
    """Return a number (*batch, N) for each agent's local state."""
    features = config.features or range(obs.shape[-1])
    cells = jnp.round(obs[..., np.array(features)] / config.resolution).astype(jnp.int32)
    return make_key(*jnp.moveaxis(cells, -1, 0))


def pairs(num_agents: int) -> tuple[np.ndarray, np.ndarray]:
    """Return i and j of all ordered pairs of two agents."""
    acts, moves = np.nonzero(~np.eye(num_agents, dtype=bool))
    return acts, moves


def make_keys(transitions: Transition, config: LocalStateConfig) -> StepKeys:
    """Return the keys of a rollout (T, E, ...)."""
    before = local_state(transitions.timestep.obs, config)
    after = local_state(transitions.outcome.obs, config)
    action, agent = transitions.action, jnp.arange(before.shape[-1])
    i, j = pairs(before.shape[-1])
    alone = make_key(ALONE, agent, before, action)
    given_other = make_key(
        GIVEN_OTHER, j, before[..., j], action[..., j], i, before[..., i], action[..., i]
    )
    return StepKeys(
        visit=make_key(VISIT, agent, after),
        alone=alone,
        alone_next=make_key(alone, after),
        given_other=given_other,
        given_other_next=make_key(given_other, after[..., j]),
    )


def count(table: Table, keys: StepKeys) -> tuple[Table, Explored]:
    """Count the steps of a rollout one after the other, those of all copies at once.

    b(i, j) = 1 - p(s'_j | s_j, a_j) / p(s'_j | s_j, a_j, s_i, a_i), with probabilities that are
    ratios of counts. This bounds the mutual information of EITI from below, as 1 - 1/x <= log x.
    As in the authors' code, influence counts the step that it is computed for. Novelty does not.
    """
    i, j = pairs(keys.alone.shape[-1])

    def step(table: Table, inputs):
        (visit, *transitions), last_visit, has_last = inputs
        table = tables.add(table, last_visit, has_last)
        for key in transitions:
            table = tables.add(table, key)
        alone, alone_next, given_other, given_other_next = (
            tables.read(table, key) for key in transitions
        )
        # Counts of keys that share their slots may exceed what they are a part of.
        likely = jnp.minimum(alone_next / alone, 1.0)
        likely_given_other = jnp.minimum(given_other_next / given_other, 1.0)
        influence = 1.0 - likely[..., j] / likely_given_other
        by_pair = jnp.zeros((*likely.shape, likely.shape[-1])).at[..., i, j].set(influence)
        novelty = jax.lax.rsqrt(tables.read(table, visit) + 1.0)
        return table, Explored(novelty, by_pair)

    # Visits are added one step later, so that the table is never read before it is written.
    has_last = (jnp.arange(len(keys.visit)) > 0).astype(jnp.int32)
    last_visit = jnp.roll(keys.visit, 1, axis=0)
    table, explored = jax.lax.scan(step, table, (keys, last_visit, has_last))
    return tables.add(table, keys.visit[-1]), explored
