"""The command `tune`, from its words to its table and its next command."""

import json
import re
import signal

import jax
import pytest

from hmasd_jax.cli import tune_command
from hmasd_jax.cli.main import main
from hmasd_jax.config import to_json
from hmasd_jax.runs import metrics_log
from hmasd_jax.runs.folder import create, metrics_path, read_config, seed_folder
from hmasd_jax.search.study import read_search
from hmasd_jax.search.trials import REASON
from hmasd_jax.training.job import Event
from hmasd_jax.training.signals import stop_on_signal
from tests.helpers.toy import words

pytest.importorskip("optuna")

VARY = ["--vary", "algorithm.scale=0.5:2"]
SHORT = ["--last", "2", "--prune-after", "1"]
STEPS = (0, 40, 80, 120, 160, 200)


@pytest.fixture
def plays(monkeypatch):
    """Replace the training: a seed's success is constant, that of its trial in `scores`.

    Return the calls and `scores`. A score may be an exception, a word for the last event of seed 0,
    or a number; it is 0 for trials that are not in it.
    """
    calls, scores = [], {}

    def pretend(config, options, words, seeds, placement, watcher):
        run = options.run_dir
        calls.append((run.name, config, options, words))
        score = scores.get(run.name, 0.0)
        if isinstance(score, Exception):
            raise score
        if not options.resume:
            create(run, config, words)
        if isinstance(score, str):
            return {seed: Event(score, seed, {"message": "bad luck"}) for seed in seeds}
        for step in STEPS:
            for seed in seeds:
                seed_folder(run, seed).mkdir(exist_ok=True)
                record = {"kind": "eval", "seed": seed, "env_steps": step, "wall_seconds": 1.0}
                writer = metrics_log.JsonLines(metrics_path(run, seed))
                writer.write(record | {"success": score if step else 1.0})
                writer.close()
                watcher.handle(Event("eval", seed, record))
            if watcher.should_stop():
                return {seed: Event("interrupted", seed, {}) for seed in seeds}
        return {seed: Event("finished", seed, {}) for seed in seeds}

    monkeypatch.setattr(tune_command, "run_seeds", pretend)
    monkeypatch.setattr(tune_command.summary, "plot", lambda console, run: None)
    return calls, scores


def tune(folder, *more, vary=VARY):
    settings = words(eval_interval=40, num_seeds=2)
    return main(["tune", "--run-dir", str(folder), *settings, *vary, *SHORT, *more])


def trials(folder):
    return read_search(folder).study.get_trials()


def test_the_best_trial_stands_beside_the_preset(plays, tmp_path, capsys):
    calls, scores = plays
    folder = tmp_path / "s"
    scores |= {"trial_0": 0.25, "trial_1": 0.75, "trial_2": 0.5}
    assert tune(folder, "--trials", "3") == 0
    out = capsys.readouterr()
    value = trials(folder)[1].params["algorithm.scale"]
    assert "3 trials: 3 complete" in out.out
    assert re.search(rf"algorithm.scale *│ 1 *│ {value:.4g} ", out.out)
    assert re.search(r"mean of the last 2 evaluations\s+│ 0.250 +│ 0.750", out.out)
    assert "confirm it with fresh seeds" in " ".join(out.out.split())
    assert out.err.splitlines()[-1] == (
        f"next: python -m hmasd_jax.train seed_sweep --config {folder}/trial_1/config.json "
        f"--seed 1 --num-seeds 10 --run-dir {folder}_best"
    )
    name, config, options, line = calls[1]
    assert (name, config.algorithm.scale, config.num_seeds) == ("trial_1", value, 2)
    assert not options.resume
    # The command that makes this folder alone.
    assert line == [
        "seed_sweep", "--config", f"{folder}/preset.json", "--algorithm.scale", str(value),
        "--run-dir", f"{folder}/trial_1",
    ]  # fmt: skip
    assert read_config(folder / "trial_1") == config
    assert to_json(calls[0][1]) == json.loads((folder / "preset.json").read_text())


def test_a_trial_that_falls_behind_is_stopped_but_never_the_preset(plays, tmp_path):
    _, scores = plays
    scores |= {"trial_0": 0.5, "trial_1": 0.25, "trial_2": 0.5}
    assert tune(tmp_path / "s", "--trials", "3") == 0
    found = trials(tmp_path / "s")
    assert [trial.state.name for trial in found] == ["COMPLETE", "PRUNED", "COMPLETE"]
    # Not before the score has as many evaluations as it counts.
    assert found[1].intermediate_values == {1: 0.25, 2: 0.25}
    assert found[2].intermediate_values == dict.fromkeys(range(1, 6), 0.5)


def test_trials_are_not_stopped_before_enough_are_complete(plays, tmp_path):
    _, scores = plays
    scores |= {"trial_0": 1.0}
    settings = words(eval_interval=40, num_seeds=2)
    more = ["--last", "1", "--prune-after", "4", "--trials", "5"]
    assert main(["tune", "--run-dir", str(tmp_path / "s"), *settings, *VARY, *more]) == 0
    states = [trial.state.name for trial in trials(tmp_path / "s")]
    assert states == ["COMPLETE"] * 4 + ["COMPLETE"]  # Equal to the median, so not behind it.


def test_a_failed_trial_has_a_reason_and_the_search_goes_on(plays, tmp_path, capsys):
    _, scores = plays
    scores |= {"trial_0": "failed", "trial_1": 0.5}
    assert tune(tmp_path / "s", "--trials", "2") == 0
    first, second = trials(tmp_path / "s")
    assert (first.state.name, second.state.name) == ("FAIL", "COMPLETE")
    assert first.user_attrs[REASON] == "seed 0: bad luck; seed 1: bad luck"
    assert "trial 0 failed: seed 0: bad luck" in capsys.readouterr().out


def test_a_trial_that_is_too_large_for_the_device_fails_alone(plays, tmp_path):
    _, scores = plays
    scores["trial_1"] = jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: 9 GiB\nDetails")
    assert tune(tmp_path / "s", "--trials", "3") == 0
    found = trials(tmp_path / "s")
    assert [trial.state.name for trial in found] == ["COMPLETE", "FAIL", "COMPLETE"]
    assert found[1].user_attrs[REASON] == "RESOURCE_EXHAUSTED: 9 GiB"


def test_values_that_do_not_fit_each_other_fail_their_trial_alone(plays, tmp_path, capsys):
    """Each value fits the preset, but not every pair of them."""
    vary = ["--vary", "algorithm.ppo.num_envs=1,20", "--vary", "algorithm.ppo.rollout_length=10,20"]
    assert tune(tmp_path / "s", "--trials", "5", vary=vary) == 0
    failed = [t for t in trials(tmp_path / "s") if t.state.name == "FAIL"]
    assert failed
    assert all("less than one update takes" in t.user_attrs[REASON] for t in failed)


def test_an_error_that_is_no_trial_s_fault_loses_nothing(plays, tmp_path, capsys):
    calls, scores = plays
    scores |= {"trial_1": OSError(28, "No space left on device")}
    folder = tmp_path / "s"
    assert tune(folder, "--trials", "3") == 1
    assert "No space left on device" in capsys.readouterr().err
    scores.clear()
    assert main(["tune", "--run-dir", str(folder), "--resume"]) == 0
    assert [name for name, *_ in calls] == ["trial_0", "trial_1", "trial_1", "trial_2"]
    assert [trial.state.name for trial in trials(folder)] == ["COMPLETE"] * 3


def test_values_of_an_earlier_trial_are_not_trained_again(plays, tmp_path, capsys):
    calls, scores = plays
    scores["trial_0"], folder = 0.25, tmp_path / "s"
    assert tune(folder, "--trials", "1") == 0
    read_search(folder).study.enqueue_trial(trials(folder)[0].params)
    assert main(["tune", "--run-dir", str(folder), "--resume", "--trials", "2"]) == 0
    assert [name for name, *_ in calls] == ["trial_0"]
    assert [trial.value for trial in trials(folder)] == [0.25, 0.25]
    assert "trial 1 has the values and so the score of trial 0" in capsys.readouterr().out


def test_a_database_that_goes_away_is_one_line(plays, tmp_path, capsys, monkeypatch):
    folder, database = tmp_path / "s", tmp_path / "s.db"
    pretend = tune_command.run_seeds

    def lose(*args, **more):
        if len(plays[0]) == 1:
            database.rename(tmp_path / "away")
            database.mkdir()
        return pretend(*args, **more)

    monkeypatch.setattr(tune_command, "run_seeds", lose)
    assert tune(folder, "--trials", "2", "--storage", f"sqlite:///{database}") == 2
    error = capsys.readouterr().err
    assert f"lost the storage of {folder}: " in error
    assert "Traceback" not in error
    database.rmdir()
    (tmp_path / "away").rename(database)
    monkeypatch.setattr(tune_command, "run_seeds", pretend)
    assert main(["tune", "--run-dir", str(folder), "--resume"]) == 0
    assert [trial.state.name for trial in trials(folder)] == ["COMPLETE"] * 2


def test_an_interrupted_search_says_how_to_go_on_and_does(plays, tmp_path, capsys):
    calls, scores = plays
    folder = tmp_path / "s"
    scores |= {"trial_1": "interrupted"}
    assert tune(folder, "--trials", "2", "--tensorboard") == 130
    out = capsys.readouterr().out
    assert "2 trials: 1 complete, 1 in training or interrupted" in out
    again = f"tune --run-dir {folder} --resume --tensorboard"
    assert f"interrupted; to continue: python -m hmasd_jax.train {again}" in out
    scores |= {"trial_1": 0.5, "trial_2": 0.25}
    assert main([*again.split(), "--trials", "3"]) == 0
    assert [(name, options.resume) for name, _, options, _ in calls] == [
        ("trial_0", False), ("trial_1", False), ("trial_1", True), ("trial_2", False),
    ]  # fmt: skip
    assert all(options.tensorboard for _, _, options, _ in calls)
    assert len(trials(folder)) == 3


def test_a_trial_whose_folder_was_never_finished_begins_again(plays, tmp_path):
    calls, scores = plays
    folder = tmp_path / "s"
    scores |= {"trial_0": "interrupted"}
    assert tune(folder, "--trials", "1") == 130
    for path in (folder / "trial_0").iterdir():  # as if the disk was full within `create`
        path.unlink()
    scores.clear()
    assert main(["tune", "--run-dir", str(folder), "--resume"]) == 0
    assert [options.resume for _, _, options, _ in calls] == [False, False]
    assert [trial.state.name for trial in trials(folder)] == ["COMPLETE"]


def test_a_signal_at_the_end_of_a_trial_ends_the_search(plays, tmp_path, monkeypatch):
    calls, _ = plays
    pretend = tune_command.run_seeds

    def finish(*args, **more):
        with stop_on_signal():
            signal.raise_signal(signal.SIGTERM)
            return pretend(*args, **more)

    monkeypatch.setattr(tune_command, "run_seeds", finish)
    assert tune(tmp_path / "s", "--trials", "3") == 130
    assert len(calls) == 1


def test_the_same_command_joins_and_another_is_refused(plays, tmp_path, capsys):
    folder = tmp_path / "s"
    assert tune(folder, "--trials", "2") == 0
    assert tune(folder, "--trials", "2") == 0
    assert len(trials(folder)) == 2
    assert tune(folder, "--algorithm.explode_at", "3") == 2
    assert "algorithm.explode_at (was -1, now 3)" in capsys.readouterr().err
    assert main(["tune", "--run-dir", str(folder), "--resume", "--last", "4"]) == 2
    assert "last (was 2, now 4)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--vary", "algorithm.scale=2:1"], "LOW must be below HIGH"),
        (["--vary", "algorithm.scale=1,2", "--trials", "3"], "more than the 2 combinations"),
        (["--vary", "algorithm.scale=2,3", "--trials", "4"], "more than the 3 combinations"),
        ([*VARY, "--trials", "0"], "trials must be at least 1"),
        ([*VARY, "--prune-after", "-1"], "prune_after must be at least 0"),
        ([*VARY, "--storage", "search.db"], "--storage must be a URL such as sqlite:///"),
        ([], "--vary must name a setting"),
    ],
)
def test_nothing_is_written_unless_the_search_can_begin(plays, tmp_path, capsys, more, message):
    folder = tmp_path / "s"
    assert main(["tune", "--run-dir", str(folder), *words(), *more]) == 2
    assert message in capsys.readouterr().err
    assert not folder.exists()


def test_only_a_search_can_be_resumed(tmp_path, capsys):
    assert main(["tune", "--run-dir", str(tmp_path), "--resume"]) == 2
    assert f"{tmp_path} is not a search: it has no preset.json" in capsys.readouterr().err


def test_other_commands_name_the_trials_of_a_search(plays, tmp_path, capsys):
    assert tune(tmp_path / "s", "--trials", "1") == 0
    assert main(["evaluate", str(tmp_path / "s")]) == 2
    assert f"is a search: name one of its trials, e.g. {tmp_path}/s/trial_0" in (
        capsys.readouterr().err
    )
