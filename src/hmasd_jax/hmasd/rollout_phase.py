"""Algorithm 1, inference phase: assign skills every k steps and act on them in between."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from envs_jax import TimeStep
from hmasd_jax.hmasd.components import Parts
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.coordinator import Assignment, assign
from hmasd_jax.hmasd.discoverer import (
    action_distribution,
    init_memory,
    state_value,
)
from hmasd_jax.networks.actor_critic import ActorCriticMemory
from hmasd_jax.rl.rollout import unroll
from hmasd_jax.types import EnvCarry, Key, StepFn, Transition

if TYPE_CHECKING:
    from distrax import Categorical


class RolloutMemory(NamedTuple):
    """What the copies carry from step to step, and from rollout to rollout."""

    low: ActorCriticMemory
    assignment: Assignment
    """In use now, with log-probability and value from when it was drawn."""
    clock: Int[Array, " E"]
    """Steps since the rollout or the episode began (see `HMASDConfig.segment_clock`)."""


class Extras(NamedTuple):
    """What the updates need to know about a step."""

    low: ActorCriticMemory
    """Memories before the step."""
    log_prob: Float[Array, "*T E N"]
    value: Float[Array, "*T E"]
    """V_l, in normalized units."""
    assignment: Assignment
    """The skills in use."""
    renewed: Bool[Array, "*T E"]
    """Whether they were drawn at this step: a segment begins."""


class Rollout(NamedTuple):
    """T steps of E copies."""

    transitions: Transition
    """(T, E, ...), with `Extras`."""
    env: EnvCarry
    """Where the copies stand after the last step."""
    memory: RolloutMemory
    """After the last step."""
    next_assignment: Assignment
    """(E, ...) What would be in use at the next step, to bootstrap both levels from; its value is
    that of the state there."""


def init_rollout_memory(num_envs: int, num_agents: int, hidden_size: int) -> RolloutMemory:
    """Memory before the first rollout; the first step draws skills."""
    low = init_memory((num_envs,), num_agents, hidden_size)
    return RolloutMemory(
        low, blank_assignment((num_envs, 1 + num_agents)), jnp.zeros(num_envs, int)
    )


def blank_assignment(shape: tuple[int, ...]) -> Assignment:
    """No skills yet."""
    return Assignment(jnp.zeros(shape, int), jnp.zeros(shape), jnp.zeros(shape))


def collect(
    parts: Parts,
    coordinator: dict,
    discoverer: dict,
    env: EnvCarry,
    memory: RolloutMemory,
    key: Key,
) -> Rollout:
    """Roll out with the given parameters of coordinator and discoverer."""
    key_rollout, key_next = jax.random.split(key)
    config = parts.config
    if config.segment_clock == "rollout":
        # T is a multiple of k, so this changes no value; but a constant clock does not depend on
        # the seed, and under vmap over seeds the coordinator still runs only every k steps.
        memory = memory._replace(clock=jnp.zeros_like(memory.clock))
    step_fn = _act_and_evaluate(parts, coordinator, discoverer)
    env, memory, transitions = unroll(
        parts.env, step_fn, env, memory, key_rollout, config.ppo.rollout_length
    )
    _, renewed = read_clock(config, memory.clock, env.first)
    state, obs = env.timestep.state, env.timestep.obs
    fresh = assign(parts.coordinator, coordinator, state, obs, key_next)
    skills = jnp.where(renewed[:, None], fresh.skills, memory.assignment.skills)
    return Rollout(transitions, env, memory, fresh._replace(skills=skills))


def read_clock(
    config: HMASDConfig, clock: Int[Array, "*batch"], first: Bool[Array, "*batch"]
) -> tuple[Int[Array, "*batch"], Bool[Array, "*batch"]]:
    """The time that counts at this step, and whether it is time for new skills (t mod k = 0)."""
    if config.segment_clock == "episode":
        clock = jnp.where(first, 0, clock)
    return clock, clock % config.skill_interval == 0


def _act_and_evaluate(parts: Parts, coordinator: dict, discoverer: dict) -> StepFn:
    """Renew skills if it is time, sample a^i ~ pi_l(.|o^i, z^i) and evaluate V_l(s, Z)."""
    config = parts.config

    def step_fn(memory: RolloutMemory, timestep: TimeStep, first, key):
        key_assign, key_act = jax.random.split(key)
        clock, renewed = read_clock(config, memory.clock, first)
        assignment = renew(
            parts, coordinator, memory.assignment, timestep, renewed, key_assign, greedy=False
        )
        actor, distribution = act(
            parts, discoverer, memory.low.actor, timestep, assignment.individual_skills, first
        )
        critic, value = state_value(
            parts.discoverer.critic,
            discoverer["critic"],
            memory.low.critic,
            timestep.state[None],
            assignment.team_skill[None],
            first[None],
            config.num_team_skills,
        )
        action = distribution.sample(seed=key_act)
        log_prob = jnp.asarray(distribution.log_prob(action))
        extras = Extras(memory.low, log_prob, value[0], assignment, renewed)
        memory = RolloutMemory(ActorCriticMemory(actor, critic), assignment, clock + 1)
        return memory, action, extras

    return step_fn


def act(
    parts: Parts,
    params: dict,
    memory: Float[Array, "*batch N hidden"],
    timestep: TimeStep,
    skills: Int[Array, "*batch N"],
    first: Bool[Array, "*batch"],
) -> tuple[Float[Array, "*batch N hidden"], "Categorical"]:
    """pi_l(.|o^i, z^i) at a single step."""
    memory, distribution = action_distribution(
        parts.discoverer.actor,
        params["actor"],
        memory,
        timestep.obs[None],
        timestep.action_mask[None],
        skills[None],
        first[None],
        parts.config.num_skills,
    )
    return memory, distribution[0]


def renew(
    parts: Parts,
    params: dict,
    current: Assignment,
    timestep: TimeStep,
    renewed: Bool[Array, "*batch"],
    key: Key,
    greedy: bool,
    fixed: Sequence[int | None] | None = None,
) -> Assignment:
    """A fresh assignment where `renewed`, the current one elsewhere."""

    def draw() -> Assignment:
        state, obs = timestep.state, timestep.obs
        fresh = assign(parts.coordinator, params, state, obs, key, greedy, fixed)
        return jax.tree.map(
            lambda new, old: jnp.where(renewed[..., None], new, old), fresh, current
        )

    return jax.lax.cond(renewed.any(), draw, lambda: current)
