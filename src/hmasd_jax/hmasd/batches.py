"""Turn a rollout into the batches of the three losses: rewards, advantages, sequences."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from hmasd_jax.exploration.greedy_copies import (
    mark_greedy,
    normalize_and_blame,
)
from hmasd_jax.hmasd.components import Parts
from hmasd_jax.hmasd.coordinator import Assignment, HighBatch
from hmasd_jax.hmasd.discriminators import SkillPair
from hmasd_jax.hmasd.distance import SkillSteps
from hmasd_jax.hmasd.rewards import high_level_reward
from hmasd_jax.hmasd.rollout_phase import Rollout
from hmasd_jax.networks.actor_critic import SequenceBatch, sequences
from hmasd_jax.networks.recurrent import apply
from hmasd_jax.rl.gae import gae, normalize_advantage, rollout_advantage, values_after
from hmasd_jax.rl.rollout import flatten, following
from hmasd_jax.rl.value_norm import ValueNorm, denormalize
from hmasd_jax.types import Key


class Segments(NamedTuple):
    """Segments as the coordinator sees them, at every step (T, E, ...); valid where `begins`."""

    state: Float[Array, "T E state"]
    obs: Float[Array, "T E N obs"]
    assignment: Assignment
    reward: Float[Array, "T E"]
    """r^h, the sum over the segment."""
    next_value: Float[Array, "T E tokens"]
    """V_h at the segment's end, in normalized units."""
    terminated: Bool[Array, "T E"]
    """True where nothing may be bootstrapped from that value."""
    done: Bool[Array, "T E"]
    """True where an episode ended with the segment's last step."""
    begins: Bool[Array, "T E"]
    """True at a segment's first step."""
    sampled: Bool[Array, "T E"]
    """True at a segment's first step if the coordinator sampled its skills."""


def skill_pairs(parts: Parts, rollout: Rollout) -> SkillPair:
    """Return D of Algorithm 1: (s_{t+1}, Z, o_{t+1}, z^{1:n}) of every step, (T, E, ...)."""
    transitions, last = rollout.transitions, rollout.env.timestep
    skills = transitions.extras.assignment.skills
    if parts.config.discriminate == "outcome":
        return SkillPair(
            state=transitions.outcome.state, obs=transitions.outcome.obs, skills=skills
        )
    state = following(transitions.timestep.state, last.state)
    return SkillPair(state=state, obs=following(transitions.timestep.obs, last.obs), skills=skills)


def skill_steps(rollout: Rollout) -> SkillSteps:
    """Return every step with its skills and its true outcome, (T E, ...)."""
    transitions = rollout.transitions
    return flatten(
        SkillSteps(
            state=transitions.timestep.state,
            obs=transitions.timestep.obs,
            next_state=transitions.outcome.state,
            next_obs=transitions.outcome.obs,
            skills=transitions.extras.assignment.skills,
        )
    )


def find_segments(parts: Parts, params: dict, rollout: Rollout) -> Segments:
    """Cut the rollout where skills were renewed. Its end cuts the last segment too."""
    transitions = rollout.transitions
    outcome, extras = transitions.outcome, transitions.extras
    last = following(extras.renewed, jnp.ones_like(extras.renewed[0]))
    steps = jnp.where(last, jnp.arange(len(last))[:, None], len(last))
    end = jax.lax.cummin(steps, reverse=True)  # of the segment each step belongs to
    next_value, terminated = values_after(
        extras.assignment.value,
        rollout.next_assignment.value,
        outcome,
        lambda: apply(parts.coordinator, params, outcome.state, outcome.obs, method="encode")[1],
        parts.config.ppo,
    )
    return Segments(
        state=transitions.timestep.state,
        obs=transitions.timestep.obs,
        assignment=extras.assignment,
        reward=high_level_reward(outcome.reward, last),
        next_value=_at(end, next_value),
        terminated=_at(end, terminated[..., 0]),
        done=_at(end, outcome.done),
        begins=extras.renewed,
        sampled=extras.sampled,
    )


def _at(steps: Int[Array, "T E"], x: Shaped[Array, "T E *rest"]) -> Shaped[Array, "T E *rest"]:
    """Take the entries of each copy at other steps."""
    return x[steps, jnp.arange(steps.shape[1])]


def _in_front(segments: Segments) -> Segments:
    """Move the first steps of segments to the front of the time axis, in order."""
    order = jnp.argsort(~segments.begins, axis=0, stable=True)
    return jax.tree.map(lambda x: _at(order, x), segments)


def high_batch(
    parts: Parts, params: dict, norm: ValueNorm, rollout: Rollout, key: Key
) -> HighBatch:
    """Build B_h: one sample per segment, taken where its skills were drawn.

    The batch has `config.num_segments` samples: a random choice of the segments whose skills the
    coordinator sampled, repeated if there are fewer. Where it sampled none, those of all segments
    have no advantage.
    """
    config, ppo = parts.config, parts.config.ppo
    segments = _in_front(find_segments(parts, params, rollout))
    begins = segments.begins[..., None]
    advantage, target = gae(
        jnp.where(begins, segments.reward[..., None], 0.0),
        jnp.where(begins, denormalize(norm, segments.assignment.value), 0.0),
        jnp.where(begins, denormalize(norm, segments.next_value), 0.0),
        segments.terminated[..., None],
        segments.done[..., None],
        ppo.discount,
        ppo.gae_lambda,
    )
    batch = HighBatch(
        state=segments.state,
        obs=segments.obs,
        assignment=segments.assignment,
        advantage=advantage,
        target=target,
    )
    any_sampled = segments.sampled.any()
    valid = jnp.where(any_sampled, segments.sampled, segments.begins)
    chosen = _choose(valid.reshape(-1), config.num_segments, key)
    batch, reward = jax.tree.map(lambda x: x[chosen], flatten((batch, segments.reward)))
    # Segments whose skills were drawn at random may teach the values, but not the policy.
    advantage = jnp.where(any_sampled, normalize_advantage(batch.advantage), 0.0)
    if config.zero_reward_guard:
        advantage = jnp.where(reward.max() > reward.min(), advantage, 0.0)
    return batch._replace(advantage=advantage)


def _choose(valid: Bool[Array, " n"], slots: int, key: Key) -> Array:
    """Return indices of `slots` valid entries, each at most once unless there are too few.

    Without any, one entry is repeated: skills that outlast a rollout may begin in none of its
    steps. Only those drawn at random can, and they do not learn.
    """
    shuffled = jnp.where(valid, jax.random.uniform(key, valid.shape), 2.0)
    count = jnp.clip(valid.sum(), 1, slots)
    return jnp.argsort(shuffled)[jnp.arange(slots) % count]


def low_batch(
    parts: Parts,
    params: dict,
    norm: ValueNorm,
    rollout: Rollout,
    reward: Float[Array, "T E N"],
) -> SequenceBatch:
    """Build B_l: advantages and targets over all T steps, then sequences of L steps.

    GAE runs straight through changes of skill: the value of the next step is V_l(s', Z') with the
    skill in use there. Advantages are normalized over the agents that have a choice in copies that
    sample.
    """
    config, transitions = parts.config, rollout.transitions
    ppo, timestep = config.ppo, transitions.timestep
    outcome, extras = transitions.outcome, transitions.extras
    skills = extras.assignment.skills
    _, last_value = parts.discoverer.value(
        params, rollout.memory.low.critic, rollout.env.timestep.state, rollout.env.first,
        rollout.next_assignment.team_skill,
    )  # fmt: skip

    def value_of_outcome():
        memory = following(extras.low.critic, rollout.memory.low.critic)
        never = jnp.zeros_like(outcome.done)
        value = parts.discoverer.value(params, memory, outcome.state, never, skills[..., 0])[1]
        return value[..., None]

    advantage, target = rollout_advantage(
        reward, extras.value[..., None], last_value[..., None], outcome, value_of_outcome, norm, ppo
    )
    greedy = mark_greedy(config)
    advantage = normalize_and_blame(
        advantage, timestep.action_mask, outcome.reward, greedy,
        partial(normalize_advantage, floor=config.low_advantage_floor),
    )  # fmt: skip
    steps = SequenceBatch(
        memory=extras.low,
        first=transitions.first,
        obs=timestep.obs,
        state=timestep.state,
        action_mask=timestep.action_mask,
        skills=skills,
        action=transitions.action,
        log_prob=extras.log_prob,
        value=extras.value,
        advantage=advantage,
        target=target,
    )
    return sequences(steps, ppo.sequence_length)
