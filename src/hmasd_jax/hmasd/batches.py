"""From a rollout to what the three losses take: rewards, advantages, targets, sequences."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hmasd_jax.gae import gae, normalize_advantage
from hmasd_jax.hmasd.collect import Rollout
from hmasd_jax.hmasd.coordinator import HighBatch
from hmasd_jax.hmasd.discoverer import LowBatch, state_value
from hmasd_jax.hmasd.discriminators import SkillPair
from hmasd_jax.hmasd.parts import Parts
from hmasd_jax.hmasd.rewards import high_level_reward
from hmasd_jax.types import Transition
from hmasd_jax.value_norm import ValueNorm, denormalize


def flatten_segments(tree, num_axes: int = 2):
    """Merge the first axes, (M, k, ...) -> (T, ...) or (T, E, ...) -> (T E, ...)."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[num_axes:]), tree)


def _and_after(x: Array, last: Array) -> Array:
    """What follows each entry of `x` on the first axis, given what follows the last."""
    return jnp.concatenate([x[1:], last[None]])


def skill_pairs(parts: Parts, rollout: Rollout) -> SkillPair:
    """D of Algorithm 1: (s_{t+1}, Z, o_{t+1}, z^{1:n}) of every step, (T, E, ...)."""
    transitions = flatten_segments(rollout.transitions)
    if parts.config.discriminate == "outcome":
        state, obs = transitions.outcome.state, transitions.outcome.obs
    else:
        state = _and_after(transitions.timestep.state, rollout.env.timestep.state)
        obs = _and_after(transitions.timestep.obs, rollout.env.timestep.obs)
    return SkillPair(state, obs, _skills_per_step(parts, rollout))


def high_batch(
    parts: Parts, params: dict, norm: ValueNorm, rollout: Rollout
) -> tuple[HighBatch, Float[Array, "M E"]]:
    """B_h: one sample per segment, taken where its skills were drawn; and the segments' r^h."""
    config, ppo = parts.config, parts.config.ppo
    transitions, assignments = rollout.transitions, rollout.assignments
    outcome = transitions.outcome
    reward, done = jax.vmap(lambda r, d: high_level_reward(r, d, config))(
        outcome.reward, outcome.done
    )
    next_value = _and_after(assignments.value, rollout.next_assignment.value)
    terminated = done
    if ppo.bootstrap_truncation:
        cut = outcome.truncated[:, -1]
        last = jax.tree.map(lambda x: x[:, -1], (outcome.state, outcome.obs))
        _, value = parts.coordinator.apply(params, *last, method="encode")
        next_value = jnp.where(cut[..., None], value, next_value)
        terminated = done & ~cut
    advantage, target = gae(
        reward[..., None],
        denormalize(norm, assignments.value),
        denormalize(norm, next_value),
        terminated[..., None],
        done[..., None],
        ppo.discount,
        ppo.gae_lambda,
    )
    advantage = normalize_advantage(advantage)
    if config.zero_reward_guard:
        advantage = jnp.where(reward.max() > reward.min(), advantage, 0.0)
    begin = jax.tree.map(lambda x: x[:, 0], transitions.timestep)
    batch = HighBatch(begin.state, begin.obs, assignments, advantage, target)
    return flatten_segments(batch), reward


def low_batch(
    parts: Parts,
    params: dict,
    norm: ValueNorm,
    rollout: Rollout,
    reward: Float[Array, "T E N"],
) -> LowBatch:
    """B_l: advantages and targets over all T steps, then sequences of `sequence_length` steps.

    GAE runs straight through changes of skill: the value of the next step is V_l(s', Z') with the
    skill in use there.
    """
    ppo = parts.config.ppo
    transitions: Transition = flatten_segments(rollout.transitions)
    skills = _skills_per_step(parts, rollout)
    outcome, extras = transitions.outcome, transitions.extras
    _, last_value = _critic(
        parts, params, rollout.memory.critic, rollout.env.timestep.state,
        rollout.next_assignment.team_skill, rollout.env.first,
    )  # fmt: skip
    next_value = _and_after(extras.value, last_value)
    terminated = outcome.done
    if ppo.bootstrap_truncation:
        memory = _and_after(extras.memory.critic, rollout.memory.critic)
        never = jnp.zeros_like(outcome.done)
        _, value = _critic(parts, params, memory, outcome.state, skills[..., 0], never)
        next_value = jnp.where(outcome.truncated, value, next_value)
        terminated = outcome.terminated
    advantage, target = gae(
        reward,
        denormalize(norm, extras.value)[..., None],
        denormalize(norm, next_value)[..., None],
        terminated[..., None],
        outcome.done[..., None],
        ppo.discount,
        ppo.gae_lambda,
    )
    begin = jax.tree.map(lambda x: x[:: ppo.sequence_length], extras.memory)
    sequences = LowBatch(
        memory=None,
        first=transitions.first,
        obs=transitions.timestep.obs,
        state=transitions.timestep.state,
        action_mask=transitions.timestep.action_mask,
        skills=skills,
        action=transitions.action,
        log_prob=extras.log_prob,
        value=extras.value,
        advantage=normalize_advantage(advantage),
        target=target,
    )
    sequences = jax.tree.map(lambda x: _cut(x, ppo.sequence_length), sequences)
    return sequences._replace(memory=flatten_segments(begin))


def _cut(x: Array, length: int) -> Array:
    """(T, E, ...) -> (T / L, L, E, ...) -> (S, L, ...) with S = T / L * E."""
    x = x.reshape(-1, length, *x.shape[1:]).swapaxes(1, 2)
    return x.reshape(-1, length, *x.shape[3:])


def _skills_per_step(parts: Parts, rollout: Rollout) -> Array:
    """(M, E, tokens) -> (T, E, tokens)."""
    return jnp.repeat(rollout.assignments.skills, parts.config.skill_interval, axis=0)


def _critic(parts, params, memory, state, team_skill, first):
    """V_l of a single step."""
    memory, value = state_value(
        parts.discoverer.critic, params["critic"], memory, state[None], team_skill[None],
        first[None], parts.config.num_team_skills,
    )  # fmt: skip
    return memory, value[0]
