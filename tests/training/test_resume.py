"""A run that is interrupted in any way and resumed equals an uninterrupted one."""

import errno
import json
import os

import numpy as np
import pytest

from hmasd_jax.cli.main import main
from hmasd_jax.config import RENAMED, build, load
from hmasd_jax.runs import checkpoint, metrics_log
from hmasd_jax.runs.checkpoint import CheckpointError
from hmasd_jax.runs.folder import checkpoint_folder, create, hold, lock, metrics_path
from hmasd_jax.runs.load import load_run
from hmasd_jax.training import loop
from hmasd_jax.training.job import Job
from hmasd_jax.training.loop import train_seeds
from tests.helpers.processes import assert_same_state, latest
from tests.helpers.toy import SETTINGS, numbers, words

FORMER = {new: old for old, new in RENAMED.items()}


def test_hmasd_in_two_parts_is_hmasd_in_one(tmp_path):
    """Compare 4 updates with 2, of which only the files remain, and 2 more."""
    config = load(
        None,
        {
            "total_env_steps": 160,
            "log_interval": 40,
            "eval_interval": 80,
            "checkpoint_interval": 80,
            "eval_episodes": 2,
            "env.max_steps": 15,
            "algorithm.skill_interval": 10,
            "algorithm.discriminator_epochs": 1,
            "algorithm.ppo.num_envs": 2,
            "algorithm.ppo.rollout_length": 20,
            "algorithm.ppo.sequence_length": 10,
            "algorithm.ppo.hidden_size": 8,
            "algorithm.ppo.num_epochs": 1,
        },
    )

    parts = build(config)  # Once, so that the programs are compiled once.

    def train(run, updates):
        # Asked before compiling, and before every stretch of one update.
        stops = iter([False] * (1 + updates) + [True])
        job = Job(run, config, *parts, (), lambda event: None, lambda: next(stops))
        return train_seeds(job, [0])[0].kind

    one, two = tmp_path / "one", tmp_path / "two"
    for run in (one, two):
        create(run, config, [])
    assert train(one, 4) == "finished"
    assert train(two, 2) == "interrupted"
    assert latest(two, 0) == 80
    assert train(two, 2) == "finished"
    assert numbers(one, 0) == numbers(two, 0)
    assert_same_state(load_run(one).state, load_run(two).state)
    assert int(load_run(two).state.num_updates) == 4


def test_seeds_in_one_program_are_resumed_together_or_apart(tmp_path):
    """Resume seeds from different steps, each step in its own group."""
    config = load(None, SETTINGS | {"total_env_steps": 160})

    built = build(config)  # Once, so that the programs are compiled once.

    def train(run, seeds, stops):
        stops = iter(stops)
        job = Job(run, config, *built, (), lambda event: None, lambda: next(stops, False))
        return {seed: event.kind for seed, event in train_seeds(job, seeds).items()}

    whole, parts = tmp_path / "whole", tmp_path / "parts"
    for run in (whole, parts):
        create(run, config, [])
    assert set(train(whole, [0, 1, 2], []).values()) == {"finished"}
    # Asked before compiling, and before every stretch of 40 env steps: there the third time for 0
    # and 1, the second for 2.
    assert set(train(parts, [0, 1], [False, False, False, True]).values()) == {"interrupted"}
    assert train(parts, [2], [False, False, True]) == {2: "interrupted"}
    assert [latest(parts, seed) for seed in range(3)] == [80, 80, 40]
    assert set(train(parts, [0, 1, 2], []).values()) == {"finished"}
    for seed in range(3):
        assert numbers(parts, seed) == numbers(whole, seed)
        assert_same_state(load_run(parts, seed).state, load_run(whole, seed).state)


@pytest.fixture
def unequal(tmp_path):
    """A job whose seed 1 has done 80 environment steps of 160, and seed 0 none."""
    config = load(None, SETTINGS | {"total_env_steps": 160})
    run = tmp_path / "run"
    create(run, config, [])
    stops = iter([False, False, False, True])
    job = Job(run, config, *build(config), (), lambda event: None, lambda: next(stops, False))
    assert train_seeds(job, [1])[1].kind == "interrupted"
    assert (latest(run, 0), latest(run, 1)) == (0, 80)
    return job


def test_seeds_that_wait_for_others_are_locked(unequal):
    """Resume seed 1 in another process while this one trains seed 0, before its turn."""
    others = []

    def report(event):
        if (event.kind, event.seed) == ("start", 0):
            others.append(train_seeds(unequal, [1])[1])

    results = train_seeds(unequal._replace(report=report), [0, 1])
    (other,) = others
    assert (other.kind, results[0].kind, results[1].kind) == ("failed", "finished", "finished")
    assert "another process is training" in other.data["message"]
    assert latest(unequal.run, 1) == 160


def test_a_checkpoint_is_read_under_the_lock(unequal, monkeypatch):
    held, read = [], loop.latest_step

    def look(folder):
        with hold(folder.parent / ".lock") as is_free:
            held.append(not is_free)
        return read(folder)

    monkeypatch.setattr(loop, "latest_step", look)
    train_seeds(unequal, [0, 1])
    assert held == [True, True]


def test_a_seed_that_another_process_trains_fails_alone(unequal):
    with lock(unequal.run, 0):
        results = train_seeds(unequal, [0, 1, 2])
    assert [results[seed].kind for seed in range(3)] == ["failed", "finished", "finished"]
    assert "another process is training" in results[0].data["message"]


@pytest.mark.parametrize("changed", [{}, {"algorithm.scale": 2.0}])
def test_a_checkpoint_that_does_not_fit_ends_its_seed_before_anything_compiles(
    changed, unequal, monkeypatch
):
    """Take the checkpoint of another configuration, or damage it if none is changed."""
    job = unequal
    if changed:
        config = load(None, SETTINGS | {"total_env_steps": 160} | changed)
        job = Job(job.run, config, *build(config), (), job.report, job.should_stop)
    else:
        (checkpoint_folder(job.run, 1) / "80.npz").write_bytes(b"")
    compiled = []
    monkeypatch.setattr(loop, "_train_group", lambda job, seeds, env_steps: compiled.extend(seeds))
    results = train_seeds(job, [0, 1])
    assert [seed.index for seed in compiled] == [0]
    assert results[1].kind == "failed"
    words = "algorithm.scale (saved" if changed else "is damaged"
    assert words in results[1].data["message"]


@pytest.fixture
def finished(tmp_path):
    run = tmp_path / "run"
    assert main(["train", "--run-dir", str(run), *words(total_env_steps=160)]) == 0
    return run


def test_a_finished_run_stays_as_it_is(finished, capsys):
    before = metrics_path(finished, 0).read_bytes()
    assert main(["train", "--run-dir", str(finished), "--resume"]) == 0
    assert metrics_path(finished, 0).read_bytes() == before
    assert "seed 0 finished at env step 160" in capsys.readouterr().out


def test_another_configuration_is_refused_by_name(finished, capsys):
    command = ["train", "--run-dir", str(finished), "--resume"]
    assert main([*command, "--algorithm.scale", "2", "--seed", "5"]) == 2
    message = capsys.readouterr().err
    assert "algorithm.scale (was 1.0, now 2.0), seed (was 0, now 5)" in message
    assert message.count("\n") == 1
    small = ["--algorithm.ppo.num-envs", "1", "--algorithm.ppo.rollout-length", "10"]
    assert main([*command, "--algorithm.name", "mat", *small]) == 2
    message = capsys.readouterr().err
    assert "algorithm.name (was toy, now mat); resume without" in message
    # the same value, said again, is no other configuration
    assert main([*command, "--algorithm.scale", "1"]) == 0


def test_a_finished_run_can_be_trained_further_and_with_more_seeds(finished, tmp_path, capsys):
    further = ["--total-env-steps", "320", "--num-seeds", "2", "--placement", "map"]
    assert main(["seed_sweep", "--run-dir", str(finished), "--resume", *further]) == 0
    at_once = tmp_path / "at_once"
    settings = words(total_env_steps=320, num_seeds=2, placement="map")
    assert main(["seed_sweep", "--run-dir", str(at_once), *settings]) == 0
    for seed in range(2):
        assert numbers(finished, seed) == numbers(at_once, seed)
        states = [load_run(run, seed).state for run in (finished, at_once)]
        assert_same_state(*states)
    capsys.readouterr()
    less = ["--resume", "--total-env-steps", "160"]
    assert main(["train", "--run-dir", str(finished), *less]) == 2
    assert "total_env_steps 320, which can be raised but not lowered" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["layout", "placement"])
def test_a_run_from_before_a_setting_was_renamed_is_resumed(name, finished, capsys):
    with_former_names(finished)
    assert load_run(finished, 0).env_steps == 160
    command = ["train", "--run-dir", str(finished), "--resume", f"--{name}", "vmap"]
    assert main([*command, "--seed", "5"]) == 2
    assert ": seed (was 0, now 5); resume without" in capsys.readouterr().err
    assert main([*command, "--total-env-steps", "320"]) == 0
    assert latest(finished, 0) == 320
    table = json.loads((finished / "config.json").read_text())
    assert table["placement"] == "vmap"
    assert "layout" not in table


def with_former_names(run):
    """Write the configurations of a run and its checkpoints as before settings were renamed."""

    def rename(table):
        return {FORMER.get(name, name): value for name, value in table.items()}

    path = run / "config.json"
    path.write_text(json.dumps(rename(json.loads(path.read_text()))))
    for path in checkpoint_folder(run, 0).glob("*.npz"):
        with np.load(path) as file:
            arrays = dict(file)
        config = rename(json.loads(arrays.pop("config").item()))
        assert "layout" in config
        np.savez(path, config=np.array(json.dumps(config)), **arrays)


def test_metrics_after_the_checkpoint_are_dropped(finished):
    """Drop the lines that a kill leaves: those of unsaved updates, and an incomplete one."""
    before = numbers(finished, 0)
    checkpoint.checkpoint_path(checkpoint_folder(finished, 0), 160).unlink()
    with metrics_path(finished, 0).open("a") as file:
        file.write('{"kind": "train", "env_steps": 200}\n{"kind": "tra')
    assert main(["train", "--run-dir", str(finished), "--resume"]) == 0
    assert numbers(finished, 0) == before


def test_counters_pass_two_to_the_32(tmp_path):
    """Train, evaluate and resume where an environment step has no index of 32 bits."""
    run, per_update = tmp_path / "run", 2**27 * 10
    intervals = dict.fromkeys(
        ("log_interval", "eval_interval", "checkpoint_interval"), 2 * per_update
    )
    copies = {"algorithm__ppo__num_envs": 2**27, "total_env_steps": 4 * per_update}
    more = words(**intervals, **copies)
    assert main(["train", "--run-dir", str(run), *more]) == 0
    further = ["--resume", "--total-env-steps", str(6 * per_update)]
    assert main(["train", "--run-dir", str(run), *further]) == 0
    evaluated = [r["env_steps"] for r in numbers(run, 0) if r["kind"] == "eval"]
    assert evaluated == [2 * n * per_update for n in range(4)]
    assert latest(run, 0) == 6 * per_update


def test_a_damaged_checkpoint_is_told_with_the_remedy(finished, capsys):
    folder = checkpoint_folder(finished, 0)
    (folder / "160.npz").unlink()
    (folder / "80.npz").write_bytes(b"")
    assert main(["train", "--run-dir", str(finished), "--resume"]) == 1
    text = capsys.readouterr().out
    assert "seed 0 failed: " in text
    assert "is damaged" in text
    assert "Traceback" not in text


@pytest.mark.parametrize("where", ["checkpoint", "metrics"])
def test_a_full_disk_ends_the_run_and_leaves_it_usable(where, tmp_path, capsys, monkeypatch):
    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        if where == "checkpoint":
            save = checkpoint.save

            def fail(folder, step, *args):
                if step > 80:
                    raise CheckpointError(f"cannot save {folder / str(step)}: the disk is full")
                save(folder, step, *args)

            patch.setattr(checkpoint, "save", fail)
        else:
            write = metrics_log.JsonLines.write

            def fail(self, record):
                if record["env_steps"] > 80:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                write(self, record)

            patch.setattr(metrics_log.JsonLines, "write", fail)
        assert main(["train", "--run-dir", str(run), *words(total_env_steps=160)]) == 1
    text = capsys.readouterr().out
    reason = "the disk is full" if where == "checkpoint" else "No space left on device"
    assert reason in text
    assert "--resume" in text
    assert latest(run, 0) == 80
    assert main(["train", "--run-dir", str(run), "--resume"]) == 0
    assert numbers(run, 0)[-1]["env_steps"] == latest(run, 0) == 160
