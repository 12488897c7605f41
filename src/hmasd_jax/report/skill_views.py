"""The part of a page about the skills of one seed: films, maps, tables and charts."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs_jax.declared import cell_pixels, describe_agents, name_actions
from hmasd_jax.analysis.frames import shrink
from hmasd_jax.analysis.render import add_captions, draw_pictures, frame_times
from hmasd_jax.analysis.skill_space import find_spaces, occupancy
from hmasd_jax.analysis.skills import FREE, Condition
from hmasd_jax.analysis.statistics import Estimate, estimate_mean
from hmasd_jax.analysis.usefulness import (
    Usefulness,
    behavior,
    measure_usefulness,
    share_useful,
    usage,
    usage_by_team_skill,
)
from hmasd_jax.report.charts import color_of, draw_space, draw_usefulness, embed, letter
from hmasd_jax.report.gather import Seed
from hmasd_jax.report.media import Film, crop_box, draw_map, make_film, picture_uri
from hmasd_jax.report.player import draw_player

MAX_WIDTH = 400
"""Widest picture on the page (pixels)."""
MAX_FRAMES = 200
"""Most frames of a film; of longer episodes every second, third, .. step is drawn."""
PLAIN = "#0072B2"
"""Color of what belongs to no skill."""


class Card(NamedTuple):
    """One skill, or the whole policy."""

    name: str
    color: str
    film: Film
    map: str | None
    """Picture of where agents are while they hold the skill; None if the environment has none."""
    facts: Usefulness | None
    """None for the whole policy."""


class Cell(NamedTuple):
    """A number in a table, with a share of its row's largest for the shade."""

    text: str
    shade: float


class SeedView(NamedTuple):
    """Contents of the page about one seed."""

    index: int
    env_steps: int
    episodes: int
    returns: Estimate
    success: Estimate | None
    useful: Estimate | None
    in_paper: Estimate | None
    player: str
    every: int
    """Steps between two frames of the player."""
    cards: dict[str, list[Card]]
    columns: list[str]
    """Columns of `behaviors`."""
    behaviors: list[tuple[str, list[Cell]]]
    matter: str | None
    given: list[tuple[str, list[Cell]]]
    """Shares of time for which the coordinator gives each agent each skill."""
    given_columns: list[str]
    spaces: list[str]


def view_seed(seed: Seed, name: str, film_limit: int, frame_budget: int) -> SeedView:
    """Draw everything of one seed.

    Args:
        seed: A studied seed.
        name: Prefix of the ids of its elements, unique on the page.
        film_limit: Most bytes of a film.
        frame_budget: Most frames of the player.
    """
    trained, study = seed.trained, seed.study
    env, free = trained.env, study.plays[FREE]
    found = measure_usefulness(study)
    films = _draw_films(seed)
    times = frame_times(study.films[FREE], MAX_FRAMES)
    player, every = draw_player(env, study.films[FREE], films[FREE], times, frame_budget)
    held = [condition for condition in study.plays if condition.kind == "held"]
    shown = held or [FREE]
    behaviors = {c: behavior(study.plays[c], name_actions(env)) for c in shown}
    columns, given = _given(seed) if study.num_skills else ([], [])
    return SeedView(
        index=seed.index,
        env_steps=study.env_steps,
        episodes=len(free.returns),
        returns=estimate_mean(free.returns),
        success=None if free.success is None else estimate_mean(free.success),
        useful=share_useful(_individual(found)) if _individual(found) else None,
        in_paper=share_useful(_individual(found), True) if _individual(found) else None,
        player=embed(player, f"{name}-player", tools=False),
        every=every,
        cards=_cards(seed, found, films, film_limit),
        columns=[letter(c.level, c.skill) if c != FREE else "policy" for c in shown],
        behaviors=_shade(behaviors),
        matter=embed(draw_usefulness(study, found), f"{name}-matter") if found else None,
        given=given,
        given_columns=columns,
        spaces=[
            embed(draw_space(space), f"{name}-space-{space.level}")
            for space in find_spaces(trained, study)
        ],
    )


def _individual(found: list[Usefulness]) -> list[Usefulness]:
    return [entry for entry in found if entry.level == "individual"]


def _draw_films(seed: Seed) -> dict[Condition, list[NDArray[np.uint8]]]:
    """Draw all films in one view, so that they can be compared."""
    env, films = seed.trained.env, seed.study.films
    pictures = draw_pictures(env, list(films.values()), MAX_WIDTH, MAX_FRAMES)
    return {
        condition: add_captions(env, episode, drawn, most=MAX_FRAMES)
        for (condition, episode), drawn in zip(films.items(), pictures)
    }


def _cards(
    seed: Seed,
    found: list[Usefulness],
    films: dict[Condition, list[NDArray[np.uint8]]],
    film_limit: int,
) -> dict[str, list[Card]]:
    """Return the cards of each level, or one of the whole policy."""
    maps = _maps(seed)
    if not found:
        film = make_film(films[FREE], film_limit)
        return {
            "Policy": [Card(name="policy", color=PLAIN, film=film, map=maps.get(FREE), facts=None)]
        }
    cards: dict[str, list[Card]] = {}
    for entry in found:
        condition = Condition("held", entry.level, entry.skill)
        card = Card(
            name=letter(entry.level, entry.skill),
            color=color_of(entry.level, entry.skill),
            film=make_film(films[condition], film_limit),
            map=maps.get(condition),
            facts=entry,
        )
        cards.setdefault(f"{entry.level.capitalize()} skills", []).append(card)
    return cards


def _maps(seed: Seed) -> dict[Condition, str]:
    """Return a map per film; empty if agents have no places."""
    env, study = seed.trained.env, seed.study
    plays = {condition: study.plays[condition] for condition in study.films}
    if study.plays[FREE].places is None:
        return {}
    picture = env.render(study.films[FREE].env_states[0])
    cell, size = cell_pixels(env, picture), picture.shape[:2]
    shares = {condition: occupancy(play, size, cell) for condition, play in plays.items()}
    whole = (slice(None), slice(None))
    box = crop_box(list(shares.values()), cell, size) if size[1] > 500 else whole
    colors = {c: PLAIN if c == FREE else color_of(c.level, c.skill) for c in shares}
    return {
        condition: picture_uri(
            shrink(draw_map(picture, share, cell, colors[condition], box), MAX_WIDTH)
        )
        for condition, share in shares.items()
    }


def _shade(behaviors: dict[Condition, dict[str, float]]) -> list[tuple[str, list[Cell]]]:
    """Return rows of numbers, shaded by row, without rows of zeros."""
    rows = []
    for measure in next(iter(behaviors.values())):
        values = [numbers[measure] for numbers in behaviors.values()]
        if not any(values):
            continue
        form = "{:.0%}" if measure.startswith("action") else "{:.2f}"
        rows.append(
            (measure, [Cell(form.format(v), abs(v) / max(map(abs, values))) for v in values])
        )
    return rows


def _given(seed: Seed) -> tuple[list[str], list[tuple[str, list[Cell]]]]:
    """Return how often each agent gets each skill, over all Z and under each Z."""
    study = seed.study
    free = study.plays[FREE]
    names = [name for name, _ in describe_agents(seed.trained.env)]
    team, individual = usage(free, study)
    columns = [letter("individual", skill) for skill in range(study.num_skills)]
    rows = [(name, _shares(shares)) for name, shares in zip(names, individual)]
    for z, table in enumerate(usage_by_team_skill(free, study)):
        used = float(team[0, z])
        if study.num_team_skills > 1 and used > 0:
            label = f"{letter('team', z)} ({used:.0%} of time): "
            rows += [(label + name, _shares(shares)) for name, shares in zip(names, table)]
    return columns, rows


def _shares(values: NDArray[np.floating]) -> list[Cell]:
    return [Cell(f"{value:.0%}", float(value)) for value in values]
