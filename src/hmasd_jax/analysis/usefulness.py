"""Tables of what each skill does and which skills matter, from a `SkillStudy`.

A skill is useful in the sense of the paper's App. F if agents that all follow it get a team reward.
The paper names no threshold, so one rewarded episode is enough. A skill may also matter only
together with others, as on Alice_and_Bob. So a skill is called useful here if, held by all agents,
it reaches at least half of the coordinator's own return, or if the return falls when it is removed.
Both must be clear from the 95 % interval over episodes.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmasd_jax.analysis.skills import FREE, Condition, Level, Plays, SkillStudy
from hmasd_jax.analysis.statistics import Estimate, estimate_fraction, estimate_mean

LEVELS: tuple[Level, ...] = ("team", "individual")


class Usefulness(NamedTuple):
    """Evidence that one skill matters. Estimates are over episodes, differences are paired."""

    level: Level
    skill: int
    used: float
    """Share of time at which the unrestricted coordinator gives the skill, over agents."""
    rewarded: float
    """Share of episodes with a team return above 0 while the team or all agents hold the skill."""
    held: Estimate
    """Return while the team or all agents hold the skill."""
    one_agent: Estimate | None
    """Return while one agent holds it, averaged over agents; None for team skills."""
    removed: Estimate
    """Return without the skill."""
    loss: Estimate
    """Return of the unrestricted coordinator minus `removed`."""
    alone: bool
    """`held` is clearly at least half of the unrestricted coordinator's return."""
    needed: bool
    """`loss` is clearly above 0."""

    @property
    def in_paper(self) -> bool:
        """True if the skill is useful in the sense of App. F."""
        return self.rewarded > 0

    @property
    def useful(self) -> bool:
        """True if the skill earns reward alone or is needed."""
        return self.alone or self.needed


def measure_usefulness(study: SkillStudy) -> list[Usefulness]:
    """Return one entry per skill that has an alternative, team skills first."""
    return [_measure(study, condition) for condition in study.plays if condition.kind == "held"]


def _measure(study: SkillStudy, held: Condition) -> Usefulness:
    plays, level, skill = study.plays, held.level, held.skill
    free = plays[FREE].returns
    returns = plays[held].returns
    removed = plays[Condition("removed", level, skill)].returns
    singles = [
        p.returns for c, p in plays.items() if c.kind == "one agent" and c[1:3] == (level, skill)
    ]
    loss = estimate_mean(free - removed)
    above_half = estimate_mean(returns - free / 2)
    return Usefulness(
        level=level,
        skill=skill,
        used=float(usage(plays[FREE], study)[LEVELS.index(level)][:, skill].mean()),
        rewarded=float((returns > 0).mean()),
        held=estimate_mean(returns),
        one_agent=estimate_mean(np.mean(singles, axis=0)) if singles else None,
        removed=estimate_mean(removed),
        loss=loss,
        alone=above_half.low >= 0 and estimate_mean(returns).low > 0,
        needed=loss.low > 0,
    )


def usage(plays: Plays, study: SkillStudy) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return how often skills are given: team skills (1, n_Z), individual skills (N, n_z).

    Shares are of the time steps of all episodes.
    """
    assert plays.skills is not None
    skills = np.asarray(plays.skills)[plays.counted]  # (steps, 1 + N)
    team = _shares(skills[:, :1], study.num_team_skills)
    return team, _shares(skills[:, 1:], study.num_skills)


def usage_by_team_skill(plays: Plays, study: SkillStudy) -> NDArray[np.floating]:
    """Return how often each Z is given each z, (n_Z, N, n_z); NaN for a Z that is never given."""
    assert plays.skills is not None
    skills = np.asarray(plays.skills)[plays.counted]
    shares = [
        _shares(skills[skills[:, 0] == z, 1:], study.num_skills)
        for z in range(study.num_team_skills)
    ]
    return np.array(shares)


def _shares(skills: NDArray[np.integer], count: int) -> NDArray[np.floating]:
    """Return the share of each skill per column of (steps, columns), (columns, count)."""
    if not len(skills):
        return np.full((skills.shape[1], count), np.nan)
    return (skills[..., None] == np.arange(count)).mean(axis=0)


def share_useful(found: list[Usefulness], in_paper: bool = False) -> Estimate:
    """Return the share of skills that are useful, with its Wilson interval."""
    marks = [entry.in_paper if in_paper else entry.useful for entry in found]
    return estimate_fraction(np.array(marks, float), 0.5)


def behavior(plays: Plays, action_names: tuple[str, ...]) -> dict[str, float]:
    """Return what agents do: shares of actions, and events per episode and team.

    An action counts where the agent had a choice. Actions of the same kind, such as attacks on
    different enemies, stay apart.
    """
    chosen = plays.actions[plays.chose]
    counts = np.bincount(chosen, minlength=len(action_names)) / max(len(chosen), 1)
    shares = {f"action: {name}": float(x) for name, x in zip(action_names, counts)}
    events = {f"event: {name}": float(x.sum(1).mean()) for name, x in plays.events.items()}
    return events | shares


def table(study: SkillStudy, action_names: tuple[str, ...]) -> list[dict[str, Any]]:
    """Return tidy rows: condition, level, skill, agent, measure, value and interval.

    The condition is that of `skills.Condition`, or `compared` for measures of `Usefulness`, which
    compare conditions.

    Example:
        >>> pandas.DataFrame(table(study, name_actions(env)))  # doctest: +SKIP
    """
    rows = []
    for condition, plays in study.plays.items():
        kind, level, skill, agent = condition
        whose = {
            "condition": kind,
            "level": None if kind == "free" else level,
            "skill": None if kind == "free" else skill,
            "agent": agent if kind == "one agent" else None,
        }
        length = float(plays.lengths.mean())
        measured = {"return": estimate_mean(plays.returns), "length": length}
        if plays.success is not None:
            measured["success"] = estimate_mean(plays.success)
        measured |= behavior(plays, action_names)
        rows += [whose | _numbers(name, value) for name, value in measured.items()]
    for entry in measure_usefulness(study):
        whose = {"condition": "compared", "level": entry.level, "skill": entry.skill, "agent": None}
        found = {
            "used": entry.used,
            "rewarded episodes when held": entry.rewarded,
            "loss when removed": entry.loss,
            "useful": float(entry.useful),
            "useful (App. F)": float(entry.in_paper),
        }
        rows += [whose | _numbers(name, value) for name, value in found.items()]
    return rows


def _numbers(measure: str, value: float | Estimate) -> dict[str, Any]:
    middle, low, high = value if isinstance(value, Estimate) else (value, None, None)
    return {"measure": measure, "value": middle, "low": low, "high": high}
