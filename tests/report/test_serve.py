"""The live page: what it answers, what it refuses, and driving with a scripted policy."""

import http.client
import threading
import time
import urllib.parse

import pytest
import uvicorn

from hmasd_jax.cli.main import main
from hmasd_jax.report import drive, serve
from hmasd_jax.runs.folder import RunError, checkpoint_folder, metrics_path
from hmasd_jax.validation import ConfigError
from tests.helpers.runs import write_run
from tests.helpers.scripted import TEAMS, scripted_run


@pytest.fixture
def scripted(monkeypatch, tmp_path):
    """A run folder in name only."""
    monkeypatch.setattr(drive, "load_run", lambda *_: scripted_run())
    return tmp_path / "run"


def test_chosen_skills_are_followed_for_one_segment(scripted):
    driver = drive.Driver(scripted, 0)
    assert driver.interval == 20
    assert driver.film is None
    assert "Step 0, return 0." in driver.show()
    driver.play([1, None, 2])
    assert driver.last.tolist() == [1, TEAMS[1, 0], 2]
    assert (driver.time, driver.total, driver.over) == (20, 0.0, False)
    assert driver.film.shown == 21
    page = driver.show()
    assert '<option value="1" selected>Z = 1</option>' in page
    assert page.count(" selected") == 2
    driver.play([None, None, None])
    # The scripted coordinator gives Z = 1 from step 20 on: the blue diamond alone is no end.
    assert driver.last.tolist() == [1, *TEAMS[1]]
    driver.play([0, None, None])
    assert driver.over
    assert driver.total == 1.0
    assert "The episode is over" in driver.show()


def test_a_segment_after_the_end_begins_another_episode(scripted):
    driver = drive.Driver(scripted, 0)
    for skills in ([0, None, None], [1, None, None]):
        driver.play(skills)
    assert driver.over
    first = driver.picture
    driver.play([0, None, None])
    assert (driver.over, driver.time) == (False, 20)
    assert driver.picture != first


@pytest.mark.parametrize(
    ("skills", "message"),
    [([0], "3 in all"), ([2, None, None], "team skill must"), ([0, None, 4], "skill of agent 2")],
)
def test_skills_that_do_not_exist_are_refused(scripted, skills, message):
    driver = drive.Driver(scripted, 0)
    with pytest.raises(ConfigError, match=message):
        driver.play(skills)
    assert driver.time == 0


def test_the_page_is_made_again_when_files_change(tmp_path):
    run = write_run(tmp_path / "run", [[0.0, 0.5]])
    live = serve.LiveReport([run], lambda version: f"page {version}")
    assert "is being made" in live.page
    assert live.look()
    first = live.page
    assert not live.look()
    with metrics_path(run, 0).open("a") as file:
        file.write("{}\n")
    assert live.look()
    assert live.page != first


def test_a_page_that_cannot_be_made_says_why(tmp_path):
    def make(version):
        raise RunError("line 3 is <damaged>")

    live = serve.LiveReport([write_run(tmp_path / "run", [[0.0]])], make)
    assert not live.look()
    assert "line 3 is &lt;damaged&gt;" in live.page


def test_checkpoints_are_ordered_by_their_steps(tmp_path):
    run = write_run(tmp_path / "run", [[0.0]])
    folder = checkpoint_folder(run, 0)
    folder.mkdir()
    live = serve.LiveReport([run], lambda version: version)
    for step in (800_000, 1_000_000, 1_200_000):
        (folder / f"{step}.npz").touch()
        assert live.look()
        assert live.page.endswith(f".{step}")


@pytest.mark.parametrize("error", [RunError("no trial yet"), OSError("no trial yet")])
def test_files_that_cannot_be_read_for_a_while_are_read_later(error, tmp_path, monkeypatch):
    run = write_run(tmp_path / "run", [[0.0]])
    live = serve.LiveReport([run], lambda version: f"page {version}")

    def fail(_):
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(serve, "expand", fail)
        assert not live.look()
        assert "no trial yet" in live.page
    assert live.look()
    assert live.page.startswith("page 0.")
    page = live.page
    with monkeypatch.context() as patch:
        patch.setattr(serve, "expand", fail)
        assert not live.look()
        assert "no trial yet" in live.page
    assert live.look()
    assert live.page == page


def test_a_page_that_fails_is_told_and_made_again_when_files_change(tmp_path, caplog):
    run, made = write_run(tmp_path / "run", [[0.0]]), []

    def make(version):
        made.append(version)
        if len(made) == 1:
            raise ValueError("<odd>")
        return "page"

    live = serve.LiveReport([run], make)
    for _ in range(2):
        assert not live.look()
        assert "ValueError: &lt;odd&gt;" in live.page
    assert len(made) == 1  # It would fail again, and to make it takes minutes.
    assert caplog.text.count("Traceback") == 1
    with metrics_path(run, 0).open("a") as file:
        file.write("{}\n")
    assert live.look()
    assert live.page == "page"


def test_a_busy_port_is_one_error():
    with serve.bind(0) as bound:
        bound.listen()
        port = bound.getsockname()[1]
        assert bound.getsockname()[0] == "127.0.0.1"
        with pytest.raises(RunError, match=f"cannot serve on port {port} .*choose another --port"):
            serve.bind(port)


@pytest.fixture
def server(scripted, tmp_path):
    """The port of a running server."""
    live = serve.LiveReport([write_run(tmp_path / "other", [[0.0]])], lambda v: f"<p>page {v}</p>")
    live.look()
    app = serve.make_app(live, lambda: drive.Driver(scripted, 0))
    with serve.bind(0) as bound:
        server = uvicorn.Server(uvicorn.Config(app, log_level="error"))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]})
        thread.start()
        while not server.started:
            time.sleep(0.01)
        yield bound.getsockname()[1]
        server.should_exit = True
        thread.join()


def ask(port, path, method="GET", host="127.0.0.1", **form):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    body = urllib.parse.urlencode(form) if form else None
    connection.request(method, path, body=body, headers={"Host": host})
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text


def test_the_server_answers_its_pages_only(server):
    assert ask(server, "/")[1].startswith("<p>page 0.")
    assert ask(server, "/")[1] == f"<p>page {ask(server, '/version')[1]}</p>"
    for path in ("/etc/passwd", "/../config.json", "/drive/../../etc/passwd", "/config.json"):
        assert ask(server, path)[0] == 404
    assert ask(server, "/", method="DELETE")[0] == 405
    assert ask(server, "/", host="evil.example")[0] == 400


def test_the_first_seed_with_a_checkpoint_is_driven(tmp_path, monkeypatch):
    run = write_run(tmp_path / "run", [[0.0]] * 3)
    with pytest.raises(RunError, match="has no checkpoint to drive yet"):
        serve._first_driver(run)
    for seed in (1, 2):
        checkpoint_folder(run, seed).mkdir()
        (checkpoint_folder(run, seed) / "300.npz").touch()
    monkeypatch.setattr(serve, "Driver", lambda *which: which)
    assert serve._first_driver(run) == (run, 1)


def test_the_command_serves_what_was_asked_for(tmp_path, monkeypatch, capsys):
    run, made, seen = write_run(tmp_path / "run", [[0.0]]), threading.Event(), []
    monkeypatch.setattr(serve, "gather_runs", lambda *a: seen.append(a) or [])
    monkeypatch.setattr(serve, "render_page", lambda *a, **more: made.set() or "page")
    monkeypatch.setattr(serve.LiveReport, "watch", serve.LiveReport.look)
    monkeypatch.setattr(uvicorn.Server, "run", lambda self, sockets: made.wait(20))
    words = ["--port", "0", "--episodes", "2", "--seeds", "1", "--solved-at", "0.5"]
    assert main(["report", str(run), "--serve", *words]) == 0
    assert seen == [([run], 2, 1, 0.5, iter)]
    assert "http://127.0.0.1:" in capsys.readouterr().out


def test_the_server_drives(server):
    status, page = ask(server, "/drive")
    assert (status, "Step 0, return 0." in page) == (200, True)
    form = {"skill0": "1", "skill1": "", "skill2": "", "act": "segment"}
    assert "Step 20, return 0." in ask(server, "/drive", "POST", **form)[1]
    status, text = ask(server, "/drive", "POST", **form | {"skill0": "7"})
    assert (status, text) == (400, "error: team skill must be between 0 and 1, got 7")
    status, text = ask(server, "/drive", "POST", **form | {"skill0": "x"})
    assert (status, text) == (400, "error: skills must be whole numbers, got x, , ")
    status, text = ask(server, "/drive", "POST", **form | {"skill0": "9" * 5000})
    assert (status, text) == (400, f"error: skills must be whole numbers, got {'9' * 20}, , ")
    assert "Step 0, return 0." in ask(server, "/drive", "POST", act="restart")[1]


def test_a_driver_that_fails_is_told_and_replaced(server, monkeypatch, caplog):
    play, drivers = drive.Driver.play, []

    def fail_once(driver, skills):
        drivers.append(driver)
        if len(drivers) == 1:
            driver.time = 7  # As if it had played half of a segment.
            raise ValueError("odd")
        play(driver, skills)

    monkeypatch.setattr(drive.Driver, "play", fail_once)
    form = {"skill0": "1", "skill1": "", "skill2": "", "act": "segment"}
    status, text = ask(server, "/drive", "POST", **form)
    assert (status, text.partition(";")[0]) == (500, "error: ValueError: odd")
    assert "Traceback" in caplog.text
    assert "Step 0, return 0." in ask(server, "/drive")[1]
    assert "Step 20, return 0." in ask(server, "/drive", "POST", **form)[1]


def test_a_browser_drives(server, browser):
    tab = browser.new_page()
    problems = []
    tab.on("pageerror", lambda error: problems.append(str(error)))
    tab.goto(f"http://127.0.0.1:{server}/drive")
    tab.select_option("select[name=skill1]", "3")
    tab.click("button[value=segment]")
    tab.wait_for_function("document.querySelector('#state').textContent.startsWith('Step 20')")
    assert "last: z = 3" in tab.locator("label", has_text="Alice").inner_text()
    tab.wait_for_function("document.querySelector('video').currentTime > 0.1")
    assert not problems
    tab.close()
