from pathlib import Path
from types import SimpleNamespace

import imageio.v3 as iio
import jax
import numpy as np
import pytest

from envs_jax.alice_and_bob import COLORS, AliceAndBob
from envs_jax.declared import describe_agents
from hmasd_jax.analysis import episodes, render, skill_maps
from hmasd_jax.analysis import frames as drawing
from hmasd_jax.cli.main import main
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.runs.folder import RunError
from hmasd_jax.validation import ConfigError
from tests.helpers.scripted import TEAMS, scripted_policy, scripted_run


@pytest.fixture(scope="module")
def trained():
    return scripted_run()


@pytest.fixture
def run(trained, monkeypatch, tmp_path):
    """A run folder in name only."""
    for module in (render, skill_maps):
        monkeypatch.setattr(module, "load_run", lambda *_: trained)
    return tmp_path / "run"


@pytest.fixture(scope="module")
def episode(trained):
    keys = jax.random.split(jax.random.key(0), 2)
    return episodes.record(trained.env, scripted_policy(None), keys)[1]


def color_of(hexadecimal: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(hexadecimal[1:]))


def test_records_whole_episodes(episode):
    length = len(episode.rewards)
    assert 20 < length < 40
    assert len(episode.env_states) == length + 1
    assert [int(state.time) for state in episode.env_states] == list(range(length + 1))
    assert episode.success is True
    np.testing.assert_array_equal(episode.rewards, [0.0] * (length - 1) + [1.0])
    np.testing.assert_array_equal(episode.skills[:20], [[0, 1, 2]] * 20)
    np.testing.assert_array_equal(episode.skills[20:], [[1, 0, 3]] * (length - 20))


def test_frames_show_team_skill_and_outcome(trained, episode):
    frames = render.draw_episodes(trained.env, [episode], ["episode 1/1"], pause=4)
    assert len(frames) == len(episode.env_states) + 4
    assert len({(frame.shape, frame.dtype) for frame in frames}) == 1
    height, width, channels = frames[0].shape
    assert (height % 2, width % 2, channels) == (0, 0, 3)
    # The frame's color is that of the Z that acts on the state shown; the last keeps the last Z.
    edges = [tuple(frame[0, 0]) for frame in frames]
    assert edges[:20] == [color_of(drawing.TEAM_COLORS[0])] * 20
    assert edges[20:] == [color_of(drawing.TEAM_COLORS[1])] * (len(frames) - 20)
    board = trained.env.render(episode.env_states[0])
    inside = slice(drawing.BORDER, drawing.BORDER + len(board))
    np.testing.assert_array_equal(frames[0][inside, inside], board)
    colors = {tuple(pixel) for pixel in frames[-1].reshape(-1, 3)}
    assert {color_of(drawing.WON), color_of(drawing.SKILL_COLORS[3])} <= colors
    assert color_of(drawing.LOST) not in colors


def test_failure_and_policies_without_skills(trained, episode):
    cut = episode._replace(
        env_states=episode.env_states[:6], skills=None, rewards=episode.rewards[:5], success=False
    )
    frames = render.draw_episodes(trained.env, [cut], [""])
    colors = {tuple(pixel) for pixel in frames[-1].reshape(-1, 3)}
    assert color_of(drawing.LOST) in colors
    assert tuple(frames[0][0, 0]) == color_of(drawing.INK)
    assert frames[0].shape[0] < render.draw_episodes(trained.env, [episode], [""])[0].shape[0]


def test_many_agents_get_more_rows_and_small_pictures_are_enlarged():
    agents = [(f"agent {i + 1}", None) for i in range(10)]
    picture = np.zeros((50, 60, 3), np.uint8)
    rows = drawing._arrange(np.arange(11), agents, 330)
    assert sum(map(len, rows)) == 11
    assert all(chip.right <= 330 - drawing.BORDER for row in rows for chip in row)
    frame = drawing.draw_frame(picture, ("step 0", ""), drawing.INK, np.arange(11), agents)
    assert frame.shape[1] == 6 * 60 + 2 * drawing.BORDER


def test_names_and_colors_of_agents_come_from_the_environment():
    class Named(AliceAndBob):
        agent_names = ("Alice", "Bob")
        agent_colors = (COLORS["alice"], COLORS["bob"])

    agents = describe_agents(Named())
    assert agents == [("Alice", COLORS["alice"]), ("Bob", COLORS["bob"])]
    picture = np.zeros((320, 320, 3), np.uint8)
    frame = drawing.draw_frame(picture, ("", ""), drawing.INK, np.zeros(3, int), agents)
    assert {COLORS["alice"], COLORS["bob"]} <= {tuple(pixel) for pixel in frame.reshape(-1, 3)}


def test_writes_a_gif(run, tmp_path):
    out = tmp_path / "new" / "episode.gif"
    assert render.render_run(run, out, team_skill=1, fps=4) == out
    frames = iio.imread(out)
    # Z = 1 only ever gets the blue diamond, so the episode goes on to the time limit.
    assert len(frames) > 20
    assert iio.immeta(out)["duration"] == 250
    assert out.stat().st_size < 1_000_000


def test_the_command_draws_the_seed_and_checkpoint_asked_for(
    trained, tmp_path, monkeypatch, capsys
):
    asked, out = [], tmp_path / "e.gif"
    monkeypatch.setattr(render, "load_run", lambda *which: asked.append(which) or trained)
    words = ["--seed-index", "2", "--step", "80", "--out", str(out)]
    assert main(["render", "run", *words]) == 0
    assert asked == [(Path("run"), 2, 80)]
    assert capsys.readouterr().out == f"{out}\n"


def test_episodes_are_drawn_in_one_view(run, tmp_path, monkeypatch):
    """Each call draws pictures that are as wide as the number of its states."""

    def draw(env, states):
        return [np.zeros((320, 320 + len(states), 3), np.uint8) for _ in states]

    monkeypatch.setattr(render, "draw_states", draw)
    out = render.render_run(run, tmp_path / "two.gif", episodes=2)
    assert len({frame.shape for frame in iio.imread(out)}) == 1


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # imageio's own, when its writer goes
def test_frames_with_more_rows_of_labels_fit_beside_others(trained, episode, suffix, tmp_path):
    """Ten and more skills have wider labels, which can take one more row."""
    pytest.importorskip("imageio_ffmpeg")
    length = len(episode.rewards)
    skills = np.where(np.arange(length)[:, None] < 9, 9, 10).repeat(3, 1)
    frames = render.draw_episodes(trained.env, [episode._replace(skills=skills)], [""])
    assert len({frame.shape for frame in frames}) == 2
    written = render.write(tmp_path / f"episode{suffix}", frames, fps=5)
    if suffix == ".gif":
        heights = {frame.shape[0] for frame in frames}
        assert iio.imread(written).shape[1] == max(heights)


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # imageio's own, when its writer goes
def test_writes_a_video(episode, trained, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    frames = render.draw_episodes(trained.env, [episode], [""])[:4]
    out = render.write(tmp_path / "episode.mp4", frames, fps=5)
    assert b"ftyp" in out.read_bytes()[:16]


def test_what_cannot_be_written_is_told_before_playing(run, tmp_path, monkeypatch):
    with pytest.raises(RunError, match=r"episode.avi: choose a name that ends in .gif or .mp4"):
        render.render_run(run, tmp_path / "episode.avi")
    monkeypatch.setattr(render.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(RunError, match=r"write a .gif, or pip install imageio-ffmpeg"):
        render.render_run(run, tmp_path / "episode.mp4")
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match=r"cannot write .*file/episode.gif: (File exists|Not a dir)"):
        render.write(tmp_path / "file" / "episode.gif", [np.zeros((4, 4, 3), np.uint8)], 5)


@pytest.mark.parametrize("fps", [0, -1.0, 1e-9, 1000, float("nan")])
def test_a_speed_that_no_film_has_is_told_before_loading(fps, tmp_path, monkeypatch):
    monkeypatch.setattr(render, "load_run", lambda *_: pytest.fail("it was loaded"))
    with pytest.raises(ConfigError, match=r"fps must be .*, got "):
        render.render_run(tmp_path, tmp_path / "x.gif", fps=fps)


@pytest.mark.parametrize("fps", [0.1, 100.0])
def test_a_gif_can_be_as_slow_and_as_fast_as_allowed(fps, tmp_path):
    frames = [np.full((16, 16, 3), value, np.uint8) for value in (0, 255)]
    out = render.write(tmp_path / "x.gif", frames, fps)
    assert iio.immeta(out)["duration"] == 1000 / fps


def test_maps_need_skills(trained, monkeypatch):
    without = trained._replace(config=SimpleNamespace(algorithm=PPOConfig()))
    monkeypatch.setattr(skill_maps, "load_run", lambda *_: without)
    with pytest.raises(RunError, match="PPO has no skills"):
        skill_maps.draw_skills("run", "maps.png")


def test_visits_are_where_skills_lead(trained):
    visits = skill_maps.visitation(trained, episodes=8)
    assert visits.shape == (4, 2, 10, 10)
    np.testing.assert_allclose(visits.sum(axis=(2, 3)), 1.0)
    # Corners take at most 14 alternating moves; steps 11 to 20 count, so most are at the corner.
    corners = [(1, 1), (1, 8), (8, 1), (8, 8)]
    for skill, corner in enumerate(corners):
        assert visits[skill, 0][corner] > 0.5


def test_choices_are_the_coordinators(trained):
    choices = skill_maps.coordinator_choices(trained, episodes=4)
    expected = np.zeros((2, 2, 4))
    for team_skill, skills in enumerate(TEAMS):
        expected[team_skill, np.arange(2), skills] = 1.0
    np.testing.assert_array_equal(choices, expected)


def test_draws_skills(run, trained, tmp_path, monkeypatch):
    monkeypatch.setattr(skill_maps, "visitation", lambda *_: np.full((4, 2, 10, 10), 0.01))
    monkeypatch.setattr(skill_maps, "coordinator_choices", lambda *_: np.full((2, 2, 4), 0.25))
    out = skill_maps.draw_skills(run, tmp_path / "skills.png")
    assert out.read_bytes().startswith(b"\x89PNG")
    other = trained._replace(env=object())
    monkeypatch.setattr(skill_maps, "load_run", lambda *_: other)
    with pytest.raises(RunError, match="is not a run on alice_and_bob"):
        skill_maps.draw_skills(run, out)


def test_of_long_episodes_some_steps_are_drawn(trained, episode):
    length = len(episode.rewards)
    assert render.frame_times(episode) == list(range(length + 1))
    times = render.frame_times(episode, most=8)
    assert times[0] == 0
    assert times[-1] == length
    assert len(times) <= 8
    (pictures,) = render.draw_pictures(trained.env, [episode], most=8)
    assert len(pictures) == len(times)
    second = trained.env.render(episode.env_states[times[1]])
    np.testing.assert_array_equal(pictures[1], second)
    frames = render.add_captions(trained.env, episode, pictures, most=8)
    colors = {tuple(pixel) for pixel in frames[-1].reshape(-1, 3)}
    assert color_of(drawing.WON) in colors
