"""Pages of tiny runs: what they say, what they never do, and how a browser shows them."""

import csv
import hashlib
import json
import re
from pathlib import Path

import pytest

from hmasd_jax.cli.main import main
from hmasd_jax.report import page
from hmasd_jax.runs.folder import RunError, write_json
from tests.helpers.runs import save_checkpoint, write_run

PPO = {"num_envs": 2, "rollout_length": 20, "hidden_size": 8, "num_epochs": 1, "sequence_length": 5}
TINY = {f"algorithm.ppo.{name}": value for name, value in PPO.items()}
HMASD = TINY | {"algorithm.skill_interval": 5, "algorithm.num_skills": 2, "env.max_steps": 12}
MAPPO = TINY | {"algorithm.name": "mappo", "env.max_steps": 12}
NOTEBOOK = Path(__file__).parents[2] / "docs" / "guides" / "skill_data.ipynb"


@pytest.fixture(scope="module")
def hmasd(tmp_path_factory):
    """A run of which seed 1 has no checkpoint and seed 2 has failed."""
    run = write_run(
        tmp_path_factory.mktemp("runs") / "skills", [[0, 0.5, 1, 1], [0, 1], []], **HMASD
    )
    save_checkpoint(run, 0, 300)
    command = ["python", "train", "--run-dir", "a run"]
    write_json(run / "run.json", {"command": command, "commit": "abc123", "jax": "1.2"})
    failed = {"status": "failed", "message": "loss is <nan>"}
    write_json(run / "summary.json", {"seeds": {"2": failed}})
    return run


@pytest.fixture(scope="module")
def mappo(tmp_path_factory):
    run = write_run(tmp_path_factory.mktemp("runs") / "flat", [[0, 0, 0, 0.2]], **MAPPO)
    save_checkpoint(run, 0, 300)
    return run


def fingerprint(run):
    files = sorted(path for path in run.rglob("*") if path.is_file())
    return [(str(path), hashlib.sha256(path.read_bytes()).digest()) for path in files]


@pytest.fixture(scope="module")
def report(hmasd, mappo, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "new" / "report.html"
    before = fingerprint(hmasd), fingerprint(mappo)
    words = ["report", str(hmasd), str(mappo), "--out", str(out), "--episodes", "3"]
    assert main(words) == 0
    assert (fingerprint(hmasd), fingerprint(mappo)) == before
    return out


def body_of(report):
    """Return the page without scripts, styles and data URIs, as one line."""
    text = re.sub(r"<(script|style).*?</\1>", "", report.read_text(), flags=re.DOTALL)
    return " ".join(re.sub(r'"data:[^"]*"', '""', text).split())


def test_the_page_needs_no_network_and_is_small(report):
    script = re.compile(r"(<script[^>]*>).*?</script>", re.DOTALL)
    text = script.sub(r"\1", report.read_text())  # The code goes, what it is loaded from stays.
    assert not re.findall(r'(?:src|href)="(?!data:|#)[^"]*"', text)
    assert not re.search(r"@import|url\((?!['\"]?data:)", text)
    assert text.count("<video") == 2 + 2 + 1  # Z, z, and the policy of MAPPO
    assert report.stat().st_size < 7e6


def test_the_page_says_what_was_run(report):
    text = body_of(report)
    assert "alice_and_bob" in text
    assert "abc123" in text
    assert "<pre>python train --run-dir &#39;a run&#39;</pre>" in text
    assert "differ from the preset alice_and_bob/hmasd" in text
    assert "differ from the preset alice_and_bob/mappo" in text
    assert re.search(
        r'class="differs"><th>algorithm.skill_interval</th><td>5</td><td>50</td>', text
    )


def test_the_page_says_what_is_missing(report):
    text = body_of(report)
    assert "Seed 1 has no skills to show: no checkpoint in" in text
    assert "Seed 2 has no evaluation yet." in text
    assert "Seed 2 failed: loss is &lt;nan&gt;." in text
    assert "With fewer than 5 seeds these intervals say little." in text


def test_the_page_shows_skills_and_their_use(report):
    text = body_of(report)
    for heading in ("Team skills", "Individual skills", "Which skills matter", "Policy"):
        assert f"<h3>{heading}</h3>" in text
    assert len(re.findall("App. F: (?:not )?useful", text)) == 4
    assert "<h3>What the policy does</h3>" in text
    assert "places of agents with z = 1" in text


def test_a_served_page_loads_itself_again_and_links_the_agents(hmasd):
    (run,) = page.gather_runs([hmasd], episodes=2, num_seeds=0, solved_at=None, track=iter)
    served, file = page.render_page([run], live="0.9.300"), page.render_page([run])
    for part in ('fetch("/version")', '"0.9.300"', 'href="/drive"'):
        assert part in served
        assert part not in file


def test_seeds_that_are_not_asked_for_are_named(hmasd):
    (run,) = page.gather_runs([hmasd], episodes=2, num_seeds=0, solved_at=None, track=iter)
    assert run.seeds == []
    assert "Skills of seeds 0, 1, 2 are not shown: ask for them with --seeds." in run.lacks


def test_all_runs_of_a_page_are_judged_by_one_metric(tmp_path):
    one = write_run(tmp_path / "one", [[0.0, 0.5]])
    other = write_run(tmp_path / "other", [[0.0, 0.5]], metric="return")
    for run in (one, other):
        found = page.gather_runs([run, one], episodes=1, num_seeds=0, solved_at=None, track=iter)
        metric = "success" if run is one else "return"
        assert [run.metric for run in found] == [metric, metric]


def test_data_goes_beside_the_page(report):
    with (report.parent / "report_skills.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["run"] for row in rows} == {"hmasd (2 seeds)", "mappo (1 seed)"}
    assert {"free", "held", "removed", "one agent", "compared"} == {r["condition"] for r in rows}
    with (report.parent / "report_curves.csv").open(newline="") as file:
        curve = [
            float(row["value"])
            for row in csv.DictReader(file)
            if (row["run"], row["seed"], row["metric"]) == ("hmasd (2 seeds)", "0", "success")
        ]
    assert curve == [0, 0.5, 1, 1]


def test_the_notebook_runs(hmasd, tmp_path, monkeypatch, capsys):
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("agg")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "example").symlink_to(hmasd)
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert len(code) >= 6
    namespace = {}
    for number, source in enumerate(code):
        # Fewer episodes than readers want.
        source = source.replace("episodes=50", "episodes=3")
        exec(compile(source, f"cell {number}", "exec"), namespace)
    assert len(plt.get_fignums()) == 2
    plt.close("all")
    assert "individual 1: given" in capsys.readouterr().out
    outputs = [cell["outputs"] for cell in cells if cell["cell_type"] == "code"]
    assert sum(map(bool, outputs)) == len(code) - 1  # Readers see results without running it.


def test_a_run_that_has_just_begun_gets_a_page(tmp_path):
    run = write_run(tmp_path / "new", [], **HMASD)
    (run / "run.json").write_text("{")
    out = page.write_report([run], tmp_path / "new.html")
    assert "no evaluation yet" in body_of(out)
    assert "The run has no seed yet." in body_of(out)
    assert "run.json cannot be read." in body_of(out)


def test_bad_input_is_one_error_and_writes_nothing(hmasd, tmp_path):
    out = tmp_path / "report.html"
    with pytest.raises(RunError, match="is not a run folder"):
        page.write_report([tmp_path], out)
    with pytest.raises(RunError, match=r"choose a name that ends in .html"):
        page.write_report([hmasd], tmp_path / "report.pdf")
    with pytest.raises(RunError, match="a report never writes into a run"):
        page.write_report([hmasd], hmasd / "report.html")
    assert not out.exists()


def test_the_size_limit_is_divided_among_films_and_frames(report, hmasd):
    class Study:
        films = dict.fromkeys(range(7))

    seeds = [type("Seed", (), {"study": Study()})] * 3
    runs = [type("Run", (), {"seeds": seeds})]
    limits = {size: page.share_bytes(runs, size) for size in (6, 15, 50)}
    for size, (film, frames) in limits.items():
        used = page.FIXED_BYTES + 18 * 4 / 3 * (film + 20_000) + 3 * frames * page.FRAME_BYTES
        assert used <= max(size * 1e6, 6.9e6)
    assert limits[50] > limits[15] > limits[6]


PLAYED = "() => [...document.querySelectorAll('video')].every(v => v.readyState > 2)"
STEP = """() => {
  const plot = document.getElementById('run0-seed0-player');
  return [plot.data[0].source, plot.data[1].x[0], plot.layout.sliders[0].active ?? 0];
}"""
"""Picture of the film, place of the cursor on the timeline, and place of the slider."""
FRAMES = """() => document.getElementById('run0-seed0-player')
  ._transitionData._frames.map(frame => [frame.name, frame.data[0].source])"""


def test_a_browser_shows_curves_films_and_the_episode_in_step(report, browser):
    tab = browser.new_page()
    problems = []
    tab.on("console", lambda message: problems.append(message.text))
    tab.on("pageerror", lambda error: problems.append(str(error)))
    tab.goto(report.as_uri())
    tab.wait_for_function(PLAYED, timeout=30_000)
    assert tab.locator("#main-evaluation .scatterlayer .trace").count() >= 2
    assert tab.evaluate(STEP)[1:] == [0, 0]
    slider = tab.locator("#run0-seed0-player .slider-rail-touch-rect")
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    tab.mouse.click(box["x"] + box["width"] * 0.7, box["y"] + box["height"] / 2)
    tab.wait_for_function(f"() => ({STEP})()[1] > 0")
    shown, time, active = tab.evaluate(STEP)
    assert [str(int(time)), shown] == tab.evaluate(FRAMES)[active]
    tab.locator("video").first.evaluate("video => video.play()")
    tab.wait_for_function("() => document.querySelector('video').currentTime > 0.1")
    assert not problems
    tab.close()


def test_the_page_fits_a_phone_and_follows_the_dark_theme(report, browser):
    tab = browser.new_page(viewport={"width": 390, "height": 800}, color_scheme="dark")
    tab.goto(report.as_uri())
    assert tab.evaluate("document.documentElement.scrollWidth") <= 390
    assert tab.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(22, 24, 27)"
    color = "getComputedStyle(document.querySelector('.xtick text')).fill"
    assert tab.evaluate(color) == "rgb(232, 233, 234)"
    tab.close()
