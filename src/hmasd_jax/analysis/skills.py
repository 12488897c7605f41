"""Play every skill of a trained policy: held, held by one agent, and removed.

The same episodes (reset and step keys) are played under every condition, so that differences
between conditions are paired. Skills and actions are chosen by arg-max. Arrays are NumPy's, with
axes E episodes, T = `max_steps` steps and N agents.
"""

from collections.abc import Callable, Iterable
from typing import Any, Literal, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from envs_jax import Environment
from envs_jax.declared import count_events, locate_agents
from hmasd_jax.analysis.episodes import Episode, Played, cut, play, skills_of
from hmasd_jax.hmasd.config import count_skills
from hmasd_jax.hmasd.policy import count_per_token, hold
from hmasd_jax.runs.load import TrainedRun

Kind = Literal["free", "held", "one agent", "removed"]
Level = Literal["team", "individual"]
Item = TypeVar("Item")
Track = Callable[[Iterable[Item]], Iterable[Item]]
"""Wrapper of a loop that shows its progress."""

NUM_SAMPLES = 24
"""Episodes of which states and observations are kept."""


class Condition(NamedTuple):
    """Restriction of the skills that the coordinator may give."""

    kind: Kind
    """`free`: none. `held`: the team, or every agent, always has the skill. `one agent`: one agent
    always has it. `removed`: the team, or every agent, never has it."""
    level: Level = "individual"
    skill: int = 0
    agent: int = 0
    """Index of the agent, for `one agent`."""


FREE = Condition("free")


class Plays(NamedTuple):
    """Episodes under one condition."""

    returns: Float[Array, " E"]
    """Undiscounted team return."""
    lengths: Int[Array, " E"]
    """Environment steps."""
    success: Float[Array, " E"] | None
    """`success` at the end; None if the environment has none."""
    counted: Bool[Array, "E T"]
    """True up to the end of each episode. Later values are meaningless."""
    actions: Int[Array, "E T N"]
    chose: Bool[Array, "E T N"]
    """True where an agent had a choice between legal actions."""
    skills: Int[Array, "E T tokens"] | None
    """Z, z^1, .., z^N; None for policies without skills."""
    events: dict[str, Float[Array, "E N"]]
    """Number of events by name, episode and agent."""
    places: Float[Array, "E T N 2"] | None
    """x and y of the agents in the picture after each step, NaN without a place."""
    states: Float[Array, "samples T state"]
    """Global states after each step of the first `NUM_SAMPLES` episodes."""
    obs: Float[Array, "samples T N obs"]
    """Observations after each step of the first `NUM_SAMPLES` episodes."""


class SkillStudy(NamedTuple):
    """All conditions of one trained seed."""

    env_steps: int
    """Environment steps of the checkpoint."""
    num_team_skills: int
    """n_Z; 0 for policies without skills."""
    num_skills: int
    """n_z; 0 for policies without skills."""
    plays: dict[Condition, Plays]
    films: dict[Condition, Episode]
    """First episode under the conditions `free` and `held`."""


Player = Callable[[Any, NDArray[np.bool_]], tuple[Plays, Played]]
"""Function of a train state and the allowed skills. It returns the episodes, and the first one with
its simulator states."""


def conditions(num_team_skills: int, num_skills: int, num_agents: int) -> list[Condition]:
    """Return all conditions. Skills without an alternative are neither held nor removed."""
    found = [FREE]
    levels: tuple[tuple[Level, int], ...] = (("team", num_team_skills), ("individual", num_skills))
    for level, count in levels:
        skills = range(count if count > 1 else 0)
        found += [Condition(kind, level, skill) for skill in skills for kind in ("held", "removed")]
    skills = range(num_skills if num_skills > 1 else 0)
    found += [Condition("one agent", "individual", z, i) for z in skills for i in range(num_agents)]
    return found


def allowed_skills(
    condition: Condition, num_team_skills: int, num_skills: int, num_agents: int
) -> NDArray[np.bool_]:
    """Return the skills that a condition allows the team and each agent, (1 + N, skills).

    Without skills it is empty.
    """
    tokens = [0] if condition.level == "team" else list(range(1, 1 + num_agents))
    if condition.kind == "one agent":
        tokens = [1 + condition.agent]
    elif condition.kind == "free":
        tokens = []
    counts = count_per_token(num_team_skills, num_skills, num_agents)
    skills = [condition.skill if token in tokens else None for token in range(len(counts))]
    allowed = hold(skills, num_team_skills, num_skills, num_agents)
    if condition.kind == "removed":
        allowed[tokens] = ~allowed[tokens]
    return allowed


def make_player(trained: TrainedRun, episodes: int = 100) -> Player:
    """Return a function that plays `episodes` episodes with any state of the run's algorithm.

    It is compiled once: the allowed skills are an argument.
    """
    env, has_skills = trained.env, any(count_skills(trained.config.algorithm))
    keys = jax.random.split(jax.random.key(0), episodes)

    @jax.jit
    def player(state: Any, allowed: NDArray[np.bool_]) -> tuple[Plays, Played]:
        limits = {"allowed": jax.numpy.asarray(allowed)} if has_skills else {}
        policy = trained.algorithm.policy(state, True, **limits)
        played = play(env, policy, keys)
        return summarize(env, played), jax.tree.map(lambda x: x[:1], played)

    return player


def study_skills(
    trained: TrainedRun, player: Player | None = None, track: Track = iter
) -> SkillStudy:
    """Play episodes under each condition.

    Example:
        >>> study = study_skills(load_run("runs/alice_and_bob"))  # doctest: +SKIP
        >>> study.plays[FREE].returns.mean()  # doctest: +SKIP

    Args:
        trained: One seed of a run, from `load_run`.
        player: Function of `make_player`, so that several seeds compile once. By default it plays
            100 episodes.
        track: Wrapper of the loop over conditions, e.g. a progress bar.
    """
    env, counts = trained.env, count_skills(trained.config.algorithm)
    player = player or make_player(trained)
    plays, films = {}, {}
    for condition in track(conditions(*counts, env.num_agents)):
        allowed = allowed_skills(condition, *counts, env.num_agents)
        summary, first = player(trained.state, allowed)
        plays[condition] = jax.device_get(summary)
        if condition.kind in ("free", "held"):
            films[condition] = cut(env, jax.device_get(first))[0]
    return SkillStudy(
        env_steps=trained.env_steps,
        num_team_skills=counts[0],
        num_skills=counts[1],
        plays=plays,
        films=films,
    )


def summarize(env: Environment, played: Played) -> Plays:
    """Return what is kept of E episodes."""
    counted, timesteps = played.counted, played.timesteps
    before = jax.tree.map(lambda x: x[:, :-1], (played.env_states, timesteps.action_mask))
    after = jax.tree.map(lambda x: x[:, 1:], (played.env_states, timesteps))
    each = lambda function: jax.vmap(jax.vmap(function))  # noqa: E731
    events = each(lambda *step: count_events(env, *step))(before[0], played.actions, after[0])
    ends = counted & after[1].done
    success = after[1].info.get("success")
    return Plays(
        returns=(after[1].reward * counted).sum(1),
        lengths=counted.sum(1),
        success=None if success is None else (success * ends).sum(1),
        counted=counted,
        actions=played.actions,
        chose=(before[1].sum(-1) > 1) & counted[..., None],
        skills=skills_of(env, played.extras),
        events={name: (x * counted[..., None]).sum(1) for name, x in events.items()},
        places=each(lambda state: locate_agents(env, state))(after[0]),
        states=after[1].state[:NUM_SAMPLES],
        obs=after[1].obs[:NUM_SAMPLES],
    )
