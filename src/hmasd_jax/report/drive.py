"""Drive the agents of a run: a person chooses the skills of the next segment and watches it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from envs_jax.declared import describe_agents
from hmasd_jax.analysis.episodes import Episode, Loop, Played, advance, skills_of, start
from hmasd_jax.analysis.frames import INK, draw_frame
from hmasd_jax.analysis.render import draw_pictures
from hmasd_jax.hmasd.config import count_skills
from hmasd_jax.hmasd.policy import count_per_token, hold
from hmasd_jax.report.media import Film, make_film, picture_uri
from hmasd_jax.report.template import load_template
from hmasd_jax.runs import checkpoint
from hmasd_jax.runs.folder import checkpoint_folder
from hmasd_jax.runs.load import load_run

MAX_WIDTH = 480
"""Widest picture (pixels)."""
FILM_BYTES = 2_000_000
STEPS_WITHOUT_SKILLS = 10
"""Steps of a segment of policies without skills."""


class Token(NamedTuple):
    """The team or an agent, as the form shows it."""

    key: str
    """Name of the field of the form."""
    name: str
    letter: str
    count: int
    """Number of skills to choose from."""
    chosen: int | None
    last: int | None
    """Skill of the last segment."""


class Driver:
    """One episode of one seed, played segment by segment."""

    def __init__(self, run: Path, seed: int) -> None:
        """Load the newest checkpoint and start an episode.

        Raises:
            RunError: `run` is not the folder of a run, or has no such seed.
            CheckpointError: There is no checkpoint.
        """
        self._run, self._seed = Path(run), seed
        self._trained = load_run(run, seed)
        self._env = self._trained.env
        self._counts = count_skills(self._trained.config.algorithm)
        self._episode_number = 0
        interval = getattr(self._trained.config.algorithm, "skill_interval", STEPS_WITHOUT_SKILLS)
        self.interval: int = min(interval, self._env.max_steps)
        self._advance = jax.jit(self._make_advance())
        self.restart()

    def restart(self) -> None:
        """Start another episode, with the newest checkpoint."""
        if (
            checkpoint.latest_step(checkpoint_folder(self._run, self._seed))
            != self._trained.env_steps
        ):
            newest = load_run(self._run, self._seed)
            self._trained = self._trained._replace(state=newest.state, env_steps=newest.env_steps)
        key_reset, self._key = jax.random.split(jax.random.key(self._episode_number))
        self._episode_number += 1
        policy = self._trained.algorithm.policy(self._trained.state, True)
        self._loop = start(self._env, policy, key_reset[None])
        self.time, self.total, self.over = 0, 0.0, False
        self.chosen: tuple[int | None, ...] = (None,) * self.num_tokens
        self.last: NDArray[np.integer] | None = None
        self.film: Film | None = None
        first = jax.device_get(jax.tree.map(lambda x: x[0], self._loop.env_states))
        empty = Episode([first], None, np.zeros(0), None)
        self.picture = picture_uri(draw_pictures(self._env, [empty], MAX_WIDTH)[0][0])

    @property
    def num_tokens(self) -> int:
        """1 + N with skills, else 0."""
        return len(count_per_token(*self._counts, self._env.num_agents))

    def play(self, skills: Sequence[int | None]) -> None:
        """Play one segment with the skills (Z, z^1, .., z^N); the coordinator chooses for None.

        Raises:
            ConfigError: Wrong number of skills, or one does not exist.
        """
        allowed = hold(skills, *self._counts, self._env.num_agents)
        if self.over:
            self.restart()
        self.chosen = tuple(skills)
        key = jax.random.fold_in(self._key, self.time)
        self._loop, played = self._advance(self._trained.state, self._loop, allowed, key)
        self._take(jax.device_get(jax.tree.map(lambda x: x[0], played)))

    def show(self) -> str:
        """Return the page."""
        names = ["team", *(name for name, _ in describe_agents(self._env))]
        tokens = [
            Token(
                key=f"skill{i}",
                name=name,
                letter="z" if i else "Z",
                count=self._counts[min(i, 1)],
                chosen=self.chosen[i],
                last=None if self.last is None else int(self.last[i]),
            )
            for i, name in enumerate(names[: self.num_tokens])
        ]
        return load_template("drive.html.j2").render(
            run=self._run.resolve().name, seed=self._seed, env_steps=self._trained.env_steps,
            tokens=tokens, interval=self.interval, time=self.time, total=self.total,
            over=self.over, film=self.film, picture=self.picture,
        )  # fmt: skip

    def _make_advance(self) -> Any:
        """Return a function that plays one segment of one copy."""

        def run(state: Any, loop: Loop, allowed: jax.Array, key: jax.Array) -> tuple[Loop, Played]:
            limits = {"allowed": allowed} if self.num_tokens else {}
            policy = self._trained.algorithm.policy(state, True, **limits)
            keys = jax.random.split(key, (self.interval, 1))
            return advance(self._env, policy, loop, keys)

        return run

    def _take(self, played: Played) -> None:
        """Add a segment, cut at the end of the episode, and draw it."""
        done = np.asarray(played.timesteps.done[1:])
        self.over = bool(done.any())
        length = int(done.argmax()) + 1 if self.over else self.interval
        states = [jax.tree.map(lambda x, t=t: x[t], played.env_states) for t in range(length + 1)]
        rewards = np.asarray(played.timesteps.reward[1 : length + 1])
        # A batch axis for `skills_of`, which tells them from other extras.
        skills = skills_of(self._env, jax.tree.map(lambda x: x[None], played.extras))
        skills = None if skills is None else skills[0, :length]
        (pictures,) = draw_pictures(self._env, [Episode(states, skills, rewards, None)], MAX_WIDTH)
        frames = []
        for step, picture in enumerate(pictures):
            total = self.total + rewards[:step].sum()
            text = f"step {self.time + step}, return {total:g}"
            shown = None if skills is None else skills[min(step, length - 1)]
            frames.append(draw_frame(picture, (text, ""), INK, shown, describe_agents(self._env)))
        self.film = make_film(frames, FILM_BYTES)
        self.time, self.total = self.time + length, self.total + float(rewards.sum())
        self.last = None if skills is None else skills[-1]
