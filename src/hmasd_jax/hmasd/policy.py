"""Execution: acting with a trained HMASD (end of Sec. 3.2)."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs_jax import TimeStep
from hmasd_jax.hmasd.components import Parts
from hmasd_jax.hmasd.coordinator import Assignment
from hmasd_jax.hmasd.discoverer import init_memory
from hmasd_jax.hmasd.rollout_phase import blank_assignment, renew
from hmasd_jax.rl.categorical import choose
from hmasd_jax.types import Key, Policy
from hmasd_jax.validation import ConfigError


class PolicyMemory(NamedTuple):
    """Memory of HMASD while it acts."""

    actor: Float[Array, "*batch N hidden"]
    assignment: Assignment
    clock: Int[Array, "*batch"]
    """Steps taken in this episode."""


def make_policy(
    parts: Parts,
    coordinator: dict,
    discoverer: dict,
    greedy: bool,
    skills: Sequence[int | None] | None = None,
    allowed: Bool[Array, "tokens skills"] | None = None,
) -> Policy:
    """Build a policy with new skills at episode steps 0, k, 2k, and so on.

    The extras of a step are the skills in use.

    Args:
        parts: networks and settings.
        coordinator: parameters of the coordinator.
        discoverer: parameters of the discoverer.
        greedy: if True, take the most probable skills and actions instead of sampling.
        skills: (Z, z^1, .., z^N) to follow instead of the coordinator's choice, to inspect what
            was learned. The coordinator still chooses those that are None, given those before.
        allowed: skills that the coordinator may give to the team and to each agent, at least one
            per token. It is an array, so that one compiled program holds or removes any skill.

    Raises:
        ConfigError: wrong number of skills, or a skill that does not exist.
    """
    config, num_agents = parts.config, parts.env.num_agents
    if skills is not None:
        counts = (config.num_team_skills, config.num_skills)
        allowed = jnp.asarray(hold(skills, *counts, num_agents))

    def init(batch_shape: tuple[int, ...] = ()) -> PolicyMemory:
        memory = init_memory(batch_shape, num_agents, config.ppo.hidden_size)
        blank = blank_assignment((*batch_shape, 1 + num_agents))
        return PolicyMemory(actor=memory.actor, assignment=blank, clock=jnp.zeros(batch_shape, int))

    def step(memory: PolicyMemory, timestep: TimeStep, first: Bool[Array, "*batch"], key: Key):
        key_assign, key_act = jax.random.split(key)
        clock = jnp.where(first, 0, memory.clock)
        renewed = clock % config.skill_interval == 0
        assignment = renew(
            parts, coordinator, memory.assignment, timestep, renewed, key_assign, greedy, allowed
        )
        actor, distribution = parts.discoverer.act(
            discoverer, memory.actor, timestep.obs, timestep.action_mask, first,
            assignment.individual_skills,
        )  # fmt: skip
        action = choose(distribution, greedy, key_act)
        memory = PolicyMemory(actor=actor, assignment=assignment, clock=clock + 1)
        return memory, action, assignment.skills

    return Policy(init, step)


def count_per_token(num_team_skills: int, num_skills: int, num_agents: int) -> list[int]:
    """Return n_Z and n_z for each agent, (1 + N,), or nothing where there are no skills."""
    return [num_team_skills] + [num_skills] * num_agents if num_skills else []


def hold(
    skills: Sequence[int | None], num_team_skills: int, num_skills: int, num_agents: int
) -> Bool[np.ndarray, "tokens skills"]:
    """Return the mask that allows each token one skill, or all where it is None.

    The coordinator itself leaves out those that a token does not have.

    Args:
        skills: (Z, z^1, .., z^N), or nothing where there are no skills.
        num_team_skills: n_Z, or 0.
        num_skills: n_z, or 0.
        num_agents: N.

    Raises:
        ConfigError: wrong number of skills, or a skill that does not exist.
    """
    counts = count_per_token(num_team_skills, num_skills, num_agents)
    if len(skills) != len(counts):
        raise ConfigError(f"skills must be Z and one per agent, {len(counts)} in all: got {skills}")
    for token, (skill, count) in enumerate(zip(skills, counts)):
        if skill is not None and not 0 <= skill < count:
            name = f"skill of agent {token}" if token else "team skill"
            raise ConfigError(f"{name} must be between 0 and {count - 1}, got {skill}")
    index = np.arange(max(num_team_skills, num_skills))
    rows = [(index >= 0) if skill is None else index == skill for skill in skills]
    return np.array(rows, bool).reshape(len(skills), len(index))
