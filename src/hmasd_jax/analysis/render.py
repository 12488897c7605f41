"""Episodes of a trained policy as animations that show the skills in use."""

import importlib.util
import warnings
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np

from envs_jax import Environment
from envs_jax.declared import describe_agents, draw_states
from envs_jax.optional import require
from hmasd_jax.analysis.episodes import Episode, record
from hmasd_jax.analysis.frames import INK, LOST, WON, draw_frame, fill_up, shrink
from hmasd_jax.runs import durable
from hmasd_jax.runs.folder import RunError
from hmasd_jax.runs.load import load_run, make_policy
from hmasd_jax.validation import FASTEST_FPS, SLOWEST_FPS, ConfigError, check_range

PAUSE = 1.5
"""Time that the end of an episode stays on screen (seconds)."""


def render_run(
    run: Path,
    out: Path,
    seed: int = 0,
    team_skill: int | None = None,
    episodes: int = 1,
    fps: float = 5,
    step: int | None = None,
    skills: Sequence[int | None] | None = None,
    greedy: bool = True,
    episode_seed: int = 0,
) -> Path:
    """Play episodes with the policy of a run and write them as an animation.

    Args:
        run: Folder of the run, finished or still running.
        out: File to write, .gif or .mp4 (which needs the package imageio-ffmpeg).
        seed: Index of the seed in the run.
        team_skill: Z to hold throughout. The coordinator then chooses only individual skills.
        episodes: Number of episodes, drawn one after the other.
        fps: Environment steps per second, from `SLOWEST_FPS` to `FASTEST_FPS`.
        step: Environment steps of the checkpoint; None selects the newest.
        skills: Skills to hold throughout, (Z, z^1, .., z^N), in place of `team_skill`. The
            coordinator chooses those that are None.
        greedy: If True, act by arg-max; else sample.
        episode_seed: Seed of the episodes, e.g. of the positions in which agents start.

    Returns:
        `out`.

    Raises:
        ConfigError: `fps` is out of range.
        MissingPackageError: imageio or Pillow is not installed.
        RunError: `run` is not the folder of a run, there is no such seed or skill, or `out`
            cannot be written.
        CheckpointError: There is no such checkpoint, or it is damaged.
    """
    for package in ("imageio", "PIL", "matplotlib"):
        require(package, "plots", "rendering")
    check_format(out)
    check_fps(fps)
    trained = load_run(run, seed, step)
    if team_skill is not None:
        skills = (team_skill, *[None] * trained.env.num_agents)
    policy = make_policy(trained, skills, greedy)
    keys = jax.random.split(jax.random.key(episode_seed), episodes)
    titles = [f"episode {i + 1}/{episodes}" for i in range(episodes)]
    played = record(trained.env, policy, keys)
    pause = round(PAUSE * fps)
    frames = draw_episodes(trained.env, played, titles if episodes > 1 else [f"seed {seed}"], pause)
    return write(out, frames, fps)


def draw_episodes(
    env: Environment, episodes: Sequence[Episode], titles: Sequence[str], pause: int = 0
) -> list[np.ndarray]:
    """Draw a frame (height, width, 3) per state of each episode, and its last `pause` times more.

    All episodes are drawn in one view.
    """
    drawn = zip(episodes, draw_pictures(env, episodes), titles)
    return [
        frame
        for episode, pictures, title in drawn
        for frame in add_captions(env, episode, pictures, title, pause)
    ]


def frame_times(episode: Episode, most: int | None = None) -> list[int]:
    """Return the steps to draw: all, or every second, third, .. and the last, at most `most`."""
    last = len(episode.env_states) - 1
    every = 1 if most is None else max(-(-last // (most - 1)), 1)
    return sorted({*range(0, last + 1, every), last})


def draw_pictures(
    env: Environment,
    episodes: Sequence[Episode],
    max_width: int | None = None,
    most: int | None = None,
) -> list[list[np.ndarray]]:
    """Draw states of episodes in one view, without captions.

    Args:
        env: Environment of the episodes.
        episodes: Episodes to draw.
        max_width: Width to which wider pictures are scaled down, in pixels.
        most: Most pictures of an episode, at its `frame_times`; None draws all states.
    """
    times = [frame_times(episode, most) for episode in episodes]
    states = [e.env_states[time] for e, own in zip(episodes, times) for time in own]
    pictures = iter(draw_states(env, states))
    return [[shrink(x, max_width) for x in islice(pictures, len(own))] for own in times]


def add_captions(
    env: Environment,
    episode: Episode,
    pictures: Sequence[np.ndarray],
    title: str = "",
    pause: int = 0,
    most: int | None = None,
) -> list[np.ndarray]:
    """Add borders and captions to the pictures of an episode.

    Args:
        env: Environment of the episode.
        episode: The episode.
        pictures: Its pictures, as `draw_pictures` returns them.
        title: Text on the right.
        pause: Number of times to repeat the last frame.
        most: As in `draw_pictures`.
    """
    length = len(episode.rewards)
    agents = describe_agents(env)
    frames = []
    for time, picture in zip(frame_times(episode, most), pictures):
        skills = None if episode.skills is None else episode.skills[min(time, length - 1)]
        total = float(episode.rewards[:time].sum())
        text, color = f"step {time}, return {total:g}", INK
        if time == length:
            outcome = {True: "success", False: "failure", None: "end"}[episode.success]
            text = f"{outcome} after {length} steps, return {total:g}"
            color = {True: WON, False: LOST, None: INK}[episode.success]
        frames.append(draw_frame(picture, (text, title), color, skills, agents))
    return frames + frames[-1:] * pause


def check_format(out: Path) -> None:
    """Check that the format of `out` can be written on this machine.

    Raises:
        RunError: The suffix is neither .gif nor .mp4, or the package for .mp4 is missing.
    """
    suffix = Path(out).suffix
    if suffix not in (".gif", ".mp4"):
        raise RunError(f"cannot write {out}: choose a name that ends in .gif or .mp4")
    if suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise RunError(f"cannot write {out}: write a .gif, or pip install imageio-ffmpeg")


def check_fps(fps: float) -> None:
    """Check that an animation can be so fast.

    Raises:
        ConfigError: `fps` is not from `SLOWEST_FPS` to `FASTEST_FPS`.
    """
    try:
        check_range(SimpleNamespace(fps=fps), "fps", low=SLOWEST_FPS, high=FASTEST_FPS)
    except ValueError as error:
        raise ConfigError(str(error)) from error


def write(out: Path, frames: Sequence[np.ndarray], fps: float) -> Path:
    """Write an animation and return `out`. Sizes of frames must be even.

    Frames that are smaller than others, with fewer rows of labels, are filled up on the right and
    below.

    Raises:
        RunError: The format is not known, or the file cannot be written.
    """
    import imageio.v3 as iio

    check_format(out)
    out, frames = Path(out), fill_up(frames)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        if out.suffix == ".gif":
            # Encoded in memory, as imageio tells a failure to write again when it is collected.
            gif = iio.imwrite("<bytes>", frames, extension=".gif", duration=1000 / fps, loop=0)
            durable.replace(out, gif)
            return out
        with warnings.catch_warnings():
            # JAX warns of a fork, but here a fork only starts the encoder, another program.
            warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
            iio.imwrite(out, np.stack(frames), fps=fps, macro_block_size=2)
    except OSError as error:
        raise RunError(f"cannot write {out}: {error.strerror or error}") from error
    return out
