"""Every command names a damaged file of a run, loses nothing and goes on with what is whole."""

import json
import shutil

import pytest

from hmasd_jax.cli.main import main
from hmasd_jax.runs import checkpoint, metrics_log
from hmasd_jax.runs.folder import checkpoint_folder, metrics_path, seeds_of
from tests.helpers.toy import numbers, words

DAMAGED_LINES = [
    b"",
    b'{"kind": "train", "env_st',
    b"\xff\xfe",
    b"3",
    b"null",
    b"{}",
    b'"eval"',
    b"[" * 100_000,
    b'{"kind": "eval", "seed": 0, "env_steps": 80, "wall_seconds": 1.0, "success": "high"}',
    b'{"kind": "eval", "seed": 0, "env_steps": 80, "wall_seconds": 1.0, "success": NaN}',
    b'{"kind": "eval", "seed": 0, "env_steps": 80, "wall_seconds": 1.0, "success": true}',
    b'{"kind": "eval", "seed": 0, "env_steps": "80", "wall_seconds": 1.0, "success": 1}',
    b'{"kind": "eval", "seed": 0, "env_steps": 80, "success": 1}',
    b'{"kind": "eval", "seed": 0, "env_steps": 80, "wall_seconds": 1' + b"0" * 400 + b"}",
    b'{"kind": "eval", "seed": 0, "env_steps": 1' + b"0" * 5000 + b', "wall_seconds": 1.0}',
]
"""Lines that are no records, all but the first of which a command must name."""

LOOKS = {
    "plot": lambda run: ["plot", run, "--out", f"{run}/drawn.png"],
    "compare": lambda run: ["compare", run, "--last", "1", "--out", f"{run}/drawn.png"],
    "evaluate": lambda run: ["evaluate", run],
    "resume": lambda run: ["seed_sweep", "--resume", "--run-dir", run],
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Train two seeds to their end and return the run folder."""
    run = tmp_path_factory.mktemp("whole") / "run"
    assert main(["seed_sweep", "--run-dir", str(run), *words(num_seeds=2, placement="map")]) == 0
    return run


@pytest.fixture
def run(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "run")


def insert(path, lines):
    """Put lines into the middle of a file."""
    before = path.read_bytes().splitlines()
    middle = len(before) // 2
    path.write_bytes(b"\n".join([*before[:middle], *lines, *before[middle:]]) + b"\n")


@pytest.fixture
def call(capfd, caplog):
    """`call(words)`: the exit code of a command line and what it said, which is no traceback."""

    def call(words):
        capfd.readouterr()
        code = main([str(word) for word in words])
        output = capfd.readouterr()
        assert "Traceback" not in output.out + output.err
        return code, output.out, output.err + "".join(f"{m}\n" for m in caplog.messages)

    return call


@pytest.mark.parametrize("line", DAMAGED_LINES, ids=lambda line: line[:30].decode("latin1"))
def test_a_line_that_is_no_record_is_left_out(line, run):
    path, before = metrics_path(run, 0), numbers(run, 0)
    insert(path, [line])
    assert numbers(run, 0) == before


def test_resuming_keeps_every_record_that_can_be_read(run, call):
    before, path = numbers(run, 0), metrics_path(run, 0)
    insert(path, DAMAGED_LINES)
    checkpoint.checkpoint_path(checkpoint_folder(run, 0), 200).unlink()  # two updates to do again
    code, out, _ = call(LOOKS["resume"](run))
    assert code == 0
    assert numbers(run, 0) == before
    kept = (path.parent / "metrics.removed.jsonl").read_bytes()
    assert all(line in kept for line in DAMAGED_LINES)
    assert f"seed 0: {len(DAMAGED_LINES) - 1} lines of {path} are no records" in out
    assert f"are now in {path.parent / 'metrics.removed.jsonl'}" in out
    path_of_whole_seed = metrics_path(run, 1)
    assert not (path_of_whole_seed.parent / "metrics.removed.jsonl").exists()


def test_a_record_without_its_line_break_stays_one(run):
    path, before = metrics_path(run, 0), numbers(run, 0)
    path.write_bytes(path.read_bytes().removesuffix(b"\n"))
    assert metrics_log.keep_until(path, 200) is None
    log = metrics_log.JsonLines(path)
    log.write({"kind": "eval", "seed": 0, "env_steps": 240, "wall_seconds": 1.0})
    log.close()
    assert numbers(run, 0)[:-1] == before
    assert not (path.parent / "metrics.removed.jsonl").exists()


def test_records_of_steps_without_a_checkpoint_are_moved_and_not_lost(run, call):
    path, before = metrics_path(run, 0), metrics_path(run, 0).read_bytes()
    shutil.rmtree(checkpoint_folder(run, 0))
    code, out, _ = call(LOOKS["resume"](run))
    assert code == 0
    assert "seed 0: fresh" in out
    assert (path.parent / "metrics.removed.jsonl").read_bytes() == before


@pytest.mark.parametrize("command", ["plot", "compare", "resume"])
def test_every_reader_of_metrics_names_the_file(command, run, call):
    path = metrics_path(run, 1)
    insert(path, DAMAGED_LINES)
    code, out, err = call(LOOKS[command](run))
    assert code == 0
    assert (out + err).count(f"lines of {path} are no records") == 1


@pytest.mark.parametrize("command", LOOKS)
@pytest.mark.parametrize(
    "text", [b"[]", b"{}", b"null", b"", b'{"env": {', b"\xff", b"[" * 100_000]
)
def test_a_damaged_configuration_is_named_and_left_alone(command, text, run, call):
    (run / "config.json").write_bytes(text)
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    code, _, err = call(LOOKS[command](run))
    assert code == 2
    assert err.startswith("error: ")
    assert f"{run}/config.json" in err
    assert err.count("\n") == 1
    assert before == {path: path.stat().st_mtime_ns for path in run.rglob("*")}


@pytest.mark.parametrize("text", ["[]", "", '{"command": ["a', "3", '{"resumed": 3}', None])
def test_a_damaged_record_of_commands_does_not_stop_a_resume(text, run, call):
    path = run / "run.json"
    path.unlink() if text is None else path.write_text(text)
    code, _, err = call(LOOKS["resume"](run))
    assert code == 0
    assert [record["device"] for record in json.loads(path.read_text())["resumed"]]
    if text is not None:
        assert (run / "run.damaged.json").read_text() == text
        assert f"{path} is " in err
        assert f"it is now {run / 'run.damaged.json'}" in err


def test_a_folder_that_is_no_seed_is_not_read(run, call):
    for name in ("seed_²", "seed_٣", "seed_01", "seed_", "seed_x", "seed_-1"):
        (run / name).mkdir()
    assert seeds_of(run) == [0, 1]
    (checkpoint_folder(run, 0) / "²").touch()
    (checkpoint_folder(run, 0) / "0400.npz").touch()
    assert checkpoint.steps(checkpoint_folder(run, 0)) == [80, 160, 200]
    assert call(LOOKS["evaluate"](run))[0] == 0


def test_seeds_are_evaluated_beside_a_damaged_checkpoint(run, call):
    path = checkpoint.checkpoint_path(checkpoint_folder(run, 0), 200)
    path.write_bytes(b"")
    code, out, err = call(LOOKS["evaluate"](run))
    assert code == 1
    assert "│ 1    │ 200" in out
    assert f"seed 0: {path} is damaged: delete it to continue from step 160" in err


@pytest.mark.parametrize("metric", ["kind", "seed", "nothing"])
def test_what_is_no_metric_cannot_be_plotted(metric, run, call):
    code, _, err = call([*LOOKS["plot"](run), "--metric", metric])
    assert code == 2
    assert f"has no evaluation of {metric} yet: there are diamonds, " in err


def test_a_log_that_cannot_be_read_is_named(run, call):
    path = metrics_path(run, 0)
    path.unlink()
    path.mkdir()
    for command in ("plot", "compare"):
        code, _, err = call(LOOKS[command](run))
        assert code == 2
        assert f"cannot read {path}" in err
    with pytest.raises(metrics_log.RunError, match="cannot read"):
        metrics_log.read(path)
