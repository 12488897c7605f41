"""The command `evaluate`: the numbers of the run, greedy or sampled, of any checkpoint."""

import pytest

from hmasd_jax.cli import inspect_commands
from hmasd_jax.cli.main import main
from hmasd_jax.config import build, load
from hmasd_jax.runs import metrics_log
from hmasd_jax.runs.folder import create, metrics_path
from hmasd_jax.training.job import Job
from hmasd_jax.training.loop import train_seeds
from tests.helpers.toy import SETTINGS, words


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of seed 1 whose return depends on the cues, the parameter and the random key."""
    run = tmp_path_factory.mktemp("runs") / "run"
    more = words(env__name="probe_match_cue", env__max_steps=1, eval_episodes=50)
    assert main(["train", "--run-dir", str(run), "--seed-index", "1", *more]) == 0
    return run


def test_numbers_are_those_of_the_run_at_every_checkpoint(run, capsys):
    records = [r for r in metrics_log.read(metrics_path(run, 1)) if r["kind"] == "eval"]
    assert len({record["return"] for record in records}) > 1  # Else nothing below can fail.
    for record in records[1:]:
        assert main(["evaluate", str(run), "--step", str(record["env_steps"])]) == 0
        assert read_row(capsys.readouterr().out) == [
            "1",
            str(record["env_steps"]),
            *(f"{record[name]:.3f}" for name in ("length", "return", "success")),
        ]


def read_row(text):
    """Return the cells of the table's only row."""
    (row,) = [line for line in text.splitlines() if line.startswith("│")]
    return [cell.strip() for cell in row.split("│")[1:-1]]


def test_the_newest_checkpoint_is_evaluated_unless_asked(run, capsys):
    assert main(["evaluate", str(run)]) == 0
    text = capsys.readouterr().out
    assert "50 greedy episodes" in text
    assert read_row(text)[1] == "200"
    assert main(["evaluate", str(run), "--sampled", "--episodes", "3"]) == 0
    assert "3 sampled episodes" in capsys.readouterr().out
    assert main(["evaluate", str(run), "--step", "7"]) == 1
    assert "error: seed 1: no checkpoint of step 7 in " in capsys.readouterr().err


def noting(algorithm, asked):
    """Return the algorithm with a policy that notes in `asked` whether it is greedy."""

    def policy(state, greedy=True):
        asked.append(greedy)
        return algorithm.policy(state, greedy)

    return algorithm._replace(policy=policy)


def test_evaluations_are_greedy_unless_asked(run, tmp_path, monkeypatch):
    config = load(None, SETTINGS)
    create(tmp_path / "run", config, [])
    env, algorithm = build(config)
    asked = []
    job = Job(
        tmp_path / "run", config, env, noting(algorithm, asked), (), lambda _: None, lambda: False
    )
    train_seeds(job, [0])
    assert set(asked) == {True}
    for more, greedy in ([], True), (["--sampled"], False):
        asked.clear()
        monkeypatch.setattr(inspect_commands, "build", lambda c: (env, noting(algorithm, asked)))
        assert main(["evaluate", str(tmp_path / "run"), *more]) == 0
        assert set(asked) == {greedy}
