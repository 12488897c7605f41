"""Space in which the discriminators tell skills apart, and maps of where skills lead."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from hmasd_jax.analysis.skills import Level, Plays, SkillStudy
from hmasd_jax.hmasd.components import make_parts
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.discriminators import SkillPair, log_q, observe
from hmasd_jax.runs.load import TrainedRun


class SkillSpace(NamedTuple):
    """Inputs of one discriminator under held skills, n samples."""

    level: Level
    points: NDArray[np.floating]
    """First two principal components of the inputs, (n, 2)."""
    skills: NDArray[np.integer]
    """Skill held, (n,)."""
    explained: NDArray[np.floating]
    """Share of the variance that each of the two components explains, (2,)."""
    confusion: NDArray[np.floating]
    """Mean probability that the discriminator gives each skill (columns) while a skill is held
    (rows), (skills, skills)."""


def find_spaces(trained: TrainedRun, study: SkillStudy, samples: int = 800) -> list[SkillSpace]:
    """Return the spaces of q_D and q_d; empty for other algorithms than HMASD.

    Args:
        trained: The seed that `study` is of.
        study: Its episodes.
        samples: Number of samples to show, divided among the skills.
    """
    if not isinstance(trained.config.algorithm, HMASDConfig):
        return []
    levels: tuple[Level, ...] = ("team", "individual")
    spaces = [_find_space(trained, study, level, samples) for level in levels]
    return [space for space in spaces if space is not None]


def _find_space(
    trained: TrainedRun, study: SkillStudy, level: Level, samples: int
) -> SkillSpace | None:
    held = {c.skill: p for c, p in study.plays.items() if c.kind == "held" and c.level == level}
    if not held:
        return None
    parts = make_parts(trained.env, trained.config.algorithm)
    drawn = [_sample(plays, samples // len(held)) for plays in held.values()]
    skills = np.repeat(list(held), [len(pair.state) for pair in drawn])
    pair = jax.tree.map(lambda *x: jnp.concatenate(x), *drawn)
    config = replace(trained.config.algorithm, discriminator_noise=0.0)
    pair = observe(pair, config, jax.random.key(0))
    params = trained.state.discriminators.params
    team, individual = jax.device_get(log_q(params, parts.discriminators, pair))
    inputs, log_prob = (pair.state, team) if level == "team" else (pair.obs[:, 0], individual[:, 0])
    points, explained = principal_components(np.asarray(inputs))
    confusion = np.array([np.exp(log_prob[skills == z]).mean(axis=0) for z in held])
    return SkillSpace(
        level=level, points=points, skills=skills, explained=explained, confusion=confusion
    )


def _sample(plays: Plays, count: int) -> SkillPair:
    """Draw steps of one agent each, as pairs with N = 1."""
    assert plays.skills is not None
    rng = np.random.default_rng(0)
    kept = plays.counted[: len(plays.states)]
    episode, time = np.nonzero(kept)
    pick = np.sort(rng.choice(len(episode), min(count, len(episode)), replace=False))
    episode, time = episode[pick], time[pick]
    agent = rng.integers(plays.obs.shape[2], size=len(pick))
    skills = plays.skills[episode, time]
    return SkillPair(
        state=jnp.asarray(plays.states[episode, time]),
        obs=jnp.asarray(plays.obs[episode, time, agent])[:, None],
        skills=jnp.asarray(np.stack([skills[:, 0], skills[np.arange(len(pick)), 1 + agent]], 1)),
    )


def principal_components(x: NDArray[np.floating]) -> tuple[NDArray, NDArray]:
    """Project (n, features) on its first two principal components.

    Returns:
        The projection (n, 2), and the share of the variance of each component (2,).
    """
    centered = x - x.mean(axis=0)
    if centered.shape[1] < 2:
        centered = np.pad(centered, ((0, 0), (0, 2 - centered.shape[1])))
    left, scale, _ = np.linalg.svd(centered, full_matrices=False)
    variance = scale**2
    return left[:, :2] * scale[:2], variance[:2] / max(variance.sum(), 1e-12)


def occupancy(
    plays: Plays, size: tuple[int, int], cell: int, agent: int | None = None
) -> NDArray[np.floating]:
    """Return the share of time that agents spend in each part of the picture.

    Args:
        plays: Episodes of an environment whose agents have places.
        size: Height and width of the picture, in pixels.
        cell: Side of the square parts, in pixels.
        agent: Index of one agent; None pools all agents.

    Returns:
        Shares that sum to 1, (rows, columns). The first row is at the top.
    """
    assert plays.places is not None
    places = plays.places[plays.counted]  # (steps, N, 2)
    places = places if agent is None else places[:, agent : agent + 1]
    places = places.reshape(-1, 2)
    columns, rows = places[np.isfinite(places).all(-1)].T
    edges = [np.arange(0, length + cell, cell) for length in size]
    counts, _, _ = np.histogram2d(rows, columns, bins=edges)
    return counts / max(counts.sum(), 1)
