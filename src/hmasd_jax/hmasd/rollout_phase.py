"""Algorithm 1, inference phase: assign skills every k steps and act on them in between."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from envs_jax import TimeStep
from hmasd_jax.exploration.greedy_copies import leave_out, mark_greedy, per_agent
from hmasd_jax.hmasd.components import Parts
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.coordinator import Assignment, assign
from hmasd_jax.hmasd.discoverer import init_memory
from hmasd_jax.hmasd.random_segments import mark_random, replace_skills
from hmasd_jax.networks.actor_critic import ActorCriticMemory
from hmasd_jax.rl.categorical import choose
from hmasd_jax.rl.rollout import unroll
from hmasd_jax.types import EnvCarry, Key, StepFn, Transition


class RolloutMemory(NamedTuple):
    """Memory of the copies from step to step and from rollout to rollout."""

    low: ActorCriticMemory
    assignment: Assignment
    """Skills in use, with log-probability and value from when they were drawn."""
    clock: Int[Array, " E"]
    """Steps since the rollout or the episode began (see `HMASDConfig.segment_clock`)."""


class Extras(NamedTuple):
    """Record of a step that the updates need."""

    low: ActorCriticMemory
    """Memories before the step."""
    log_prob: Float[Array, "*T E N"]
    value: Float[Array, "*T E"]
    """V_l, in normalized units."""
    assignment: Assignment
    """Skills in use."""
    renewed: Bool[Array, "*T E"]
    """True where skills were drawn at this step, so that a segment begins."""
    sampled: Bool[Array, "*T E"]
    """True where the coordinator sampled them: they are neither its likeliest nor random ones."""


class Rollout(NamedTuple):
    """T steps of E copies."""

    transitions: Transition
    """Steps of the rollout, (T, E, ...), with `Extras`."""
    env: EnvCarry
    """State of the copies after the last step."""
    memory: RolloutMemory
    """Memory after the last step."""
    next_assignment: Assignment
    """(E, ...) Skills in use at the next step, with the value of the state there. Both levels
    bootstrap from it."""


def init_rollout_memory(num_envs: int, num_agents: int, hidden_size: int) -> RolloutMemory:
    """Return the memory before the first rollout. The first step draws skills."""
    return RolloutMemory(
        low=init_memory((num_envs,), num_agents, hidden_size),
        assignment=blank_assignment((num_envs, 1 + num_agents)),
        clock=jnp.zeros(num_envs, int),
    )


def blank_assignment(shape: tuple[int, ...]) -> Assignment:
    """Return the assignment before the first draw."""
    return Assignment(
        skills=jnp.zeros(shape, int), log_prob=jnp.zeros(shape), value=jnp.zeros(shape)
    )


def collect(
    parts: Parts,
    coordinator: dict,
    discoverer: dict,
    env: EnvCarry,
    memory: RolloutMemory,
    key: Key,
    random_share: float | Float[Array, ""] = 0.0,
) -> Rollout:
    """Roll out for T steps with the given parameters of coordinator and discoverer.

    A share of the segments draws all skills at random if `config.solved.random_share` is set.
    """
    key_rollout, key_next = jax.random.split(key)
    config = parts.config
    if config.segment_clock == "rollout":
        # T is a multiple of k, so this changes no value. But a constant clock does not depend on
        # the seed, so that under vmap over seeds the coordinator still runs only every k steps.
        memory = memory._replace(clock=jnp.zeros_like(memory.clock))
    step_fn = _act_and_evaluate(parts, coordinator, discoverer, random_share)
    env, memory, transitions = unroll(
        parts.env, step_fn, env, memory, key_rollout, config.ppo.rollout_length
    )
    _, renewed = read_clock(config, memory.clock, env.first)
    state, obs = env.timestep.state, env.timestep.obs
    greedy = mark_greedy(config)
    fresh = assign(parts.coordinator, coordinator, state, obs, key_next, greedy)
    random = mark_random(config, random_share, key_next)
    fresh = replace_skills(parts.coordinator, fresh, key_next, random)
    skills = jnp.where(renewed[:, None], fresh.skills, memory.assignment.skills)
    return Rollout(
        transitions=transitions,
        env=env,
        memory=memory,
        next_assignment=fresh._replace(skills=skills),
    )


def read_clock(
    config: HMASDConfig, clock: Int[Array, "*batch"], first: Bool[Array, "*batch"]
) -> tuple[Int[Array, "*batch"], Bool[Array, "*batch"]]:
    """Return the time at this step, and True where new skills are due (t mod k = 0)."""
    if config.segment_clock == "episode":
        clock = jnp.where(first, 0, clock)
    return clock, clock % config.skill_interval == 0


def _act_and_evaluate(
    parts: Parts, coordinator: dict, discoverer: dict, random_share: float | Float[Array, ""]
) -> StepFn:
    """Build a step that renews due skills, samples a^i ~ pi_l(.|o^i, z^i) and evaluates V_l.

    Copies that act greedily take the most likely skills and actions. A share of the segments draws
    all skills with the same chance.
    """
    greedy = mark_greedy(parts.config)

    def step_fn(memory: RolloutMemory, timestep: TimeStep, first, key):
        key_assign, key_act = jax.random.split(key)
        clock, renewed = read_clock(parts.config, memory.clock, first)
        random = mark_random(parts.config, random_share, key_assign)
        assignment = renew(
            parts, coordinator, memory.assignment, timestep, renewed, key_assign, greedy,
            random=random,
        )  # fmt: skip
        actor, distribution = parts.discoverer.act(
            discoverer, memory.low.actor, timestep.obs, timestep.action_mask, first,
            assignment.individual_skills,
        )  # fmt: skip
        critic, value = parts.discoverer.value(
            discoverer, memory.low.critic, timestep.state, first, assignment.team_skill
        )
        action = choose(distribution, per_agent(greedy), key_act)
        extras = Extras(
            low=memory.low,
            log_prob=jnp.asarray(distribution.log_prob(action)),
            value=value,
            assignment=assignment,
            renewed=renewed,
            sampled=leave_out(leave_out(renewed, greedy), random),
        )
        low = ActorCriticMemory(actor=actor, critic=critic)
        return RolloutMemory(low=low, assignment=assignment, clock=clock + 1), action, extras

    return step_fn


def renew(
    parts: Parts,
    params: dict,
    current: Assignment,
    timestep: TimeStep,
    renewed: Bool[Array, "*batch"],
    key: Key,
    greedy: bool | Bool[Array, "*batch"],
    allowed: Bool[Array, "tokens skills"] | None = None,
    random: bool | Bool[Array, " E"] = False,
) -> Assignment:
    """Return a fresh assignment where `renewed`, and the current one elsewhere."""

    def draw() -> Assignment:
        state, obs = timestep.state, timestep.obs
        fresh = assign(parts.coordinator, params, state, obs, key, greedy, allowed)
        fresh = replace_skills(parts.coordinator, fresh, key, random)
        return jax.tree.map(
            lambda new, old: jnp.where(renewed[..., None], new, old), fresh, current
        )

    return jax.lax.cond(renewed.any(), draw, lambda: current)
