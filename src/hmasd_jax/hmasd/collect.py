"""Algorithm 1, inference phase: assign skills every k steps and act on them in between."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from envs_jax import TimeStep
from hmasd_jax.hmasd.coordinator import Assignment, assign
from hmasd_jax.hmasd.discoverer import (
    DiscovererMemory,
    action_distribution,
    init_memory,
    state_value,
)
from hmasd_jax.hmasd.parts import Parts
from hmasd_jax.rollout import unroll
from hmasd_jax.types import EnvCarry, Key, Policy, StepFn, Transition


class LowExtras(NamedTuple):
    """What the discoverer's update needs to know about a step."""

    memory: DiscovererMemory
    """Memories before the step."""
    log_prob: Float[Array, "*T E N"]
    value: Float[Array, "*T E"]


class Rollout(NamedTuple):
    """T = M k steps of E copies."""

    transitions: Transition
    """(M, k, E, ...), with `LowExtras`."""
    assignments: Assignment
    """(M, E, ...)."""
    env: EnvCarry
    """Where the copies stand after the last step."""
    memory: DiscovererMemory
    """Memories after the last step."""
    next_assignment: Assignment
    """(E, ...) Drawn at the state after the last step, to bootstrap both levels from."""


def collect(
    parts: Parts,
    coordinator: dict,
    discoverer: dict,
    env: EnvCarry,
    memory: DiscovererMemory,
    key: Key,
) -> Rollout:
    """Roll out with the given parameters of coordinator and discoverer.

    As in the authors' code the skill interval counts rollout steps, for all copies at once: an
    episode that ends early is followed by another under the same skills.
    """
    key_rollout, key_next = jax.random.split(key)
    config = parts.config

    def segment(loop, key):
        env, memory = loop
        key_assign, key_unroll = jax.random.split(key)
        state, obs = env.timestep.state, env.timestep.obs
        assignment = assign(parts.coordinator, coordinator, state, obs, key_assign)
        step_fn = _act_and_evaluate(parts, discoverer, assignment.skills)
        env, memory, transitions = unroll(
            parts.env, step_fn, env, memory, key_unroll, config.skill_interval
        )
        return (env, memory), (transitions, assignment)

    keys = jax.random.split(key_rollout, config.ppo.rollout_length // config.skill_interval)
    (env, memory), (transitions, assignments) = jax.lax.scan(segment, (env, memory), keys)
    last = env.timestep
    next_assignment = assign(parts.coordinator, coordinator, last.state, last.obs, key_next)
    return Rollout(transitions, assignments, env, memory, next_assignment)


def _act_and_evaluate(parts: Parts, params: dict, skills: Int[Array, "E tokens"]) -> StepFn:
    """Sample a^i ~ pi_l(.|o^i, z^i) and evaluate V_l(s, Z)."""

    def step_fn(memory, timestep, first, key):
        actor, distribution = action_distribution(
            parts.discoverer.actor,
            params["actor"],
            memory.actor,
            timestep.obs[None],
            timestep.action_mask[None],
            skills[None, :, 1:],
            first[None],
            parts.config.num_skills,
        )
        critic, value = state_value(
            parts.discoverer.critic,
            params["critic"],
            memory.critic,
            timestep.state[None],
            skills[None, :, 0],
            first[None],
            parts.config.num_team_skills,
        )
        action = distribution.sample(seed=key)
        extras = LowExtras(memory, distribution.log_prob(action)[0], value[0])
        return DiscovererMemory(actor, critic), action[0], extras

    return step_fn


class PolicyMemory(NamedTuple):
    """What HMASD remembers while it acts."""

    actor: Float[Array, "*batch N hidden"]
    skills: Int[Array, "*batch tokens"]
    """In use now: Z, then z^1..z^N."""
    time: Int[Array, "*batch"]
    """Steps taken in this episode."""


def make_policy(parts: Parts, coordinator: dict, discoverer: dict, greedy: bool) -> Policy:
    """Execution (end of Sec. 3.2): new skills at episode steps 0, k, 2k, ..; extras: the skills."""
    config, num_agents = parts.config, parts.env.num_agents

    def init(batch_shape: tuple[int, ...] = ()) -> PolicyMemory:
        memory = init_memory(batch_shape, num_agents, config.ppo.hidden_size)
        skills = jnp.zeros((*batch_shape, 1 + num_agents), int)
        return PolicyMemory(memory.actor, skills, jnp.zeros(batch_shape, int))

    def step(memory: PolicyMemory, timestep: TimeStep, first: Bool[Array, "*batch"], key: Key):
        key_assign, key_act = jax.random.split(key)
        time = jnp.where(first, 0, memory.time)
        renew = time % config.skill_interval == 0

        def draw_skills():
            return assign(
                parts.coordinator, coordinator, timestep.state, timestep.obs, key_assign, greedy
            ).skills

        fresh = jax.lax.cond(renew.any(), draw_skills, lambda: memory.skills)
        skills = jnp.where(renew[..., None], fresh, memory.skills)
        actor, distribution = action_distribution(
            parts.discoverer.actor,
            discoverer["actor"],
            memory.actor,
            timestep.obs[None],
            timestep.action_mask[None],
            skills[None, ..., 1:],
            first[None],
            config.num_skills,
        )
        action = distribution.mode() if greedy else distribution.sample(seed=key_act)
        return PolicyMemory(actor, skills, time + 1), action[0], skills

    return Policy(init, step)
