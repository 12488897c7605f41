"""A run that is interrupted in any way and resumed equals an uninterrupted one."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from hmasd_jax.cli.main import main
from hmasd_jax.config import build, load
from hmasd_jax.runs import checkpoint, metrics_log
from hmasd_jax.runs.checkpoint import CheckpointError
from hmasd_jax.runs.folder import available_cores, checkpoint_folder, create, metrics_path
from hmasd_jax.runs.load import load_run
from hmasd_jax.training.job import Job
from hmasd_jax.training.loop import train_seeds
from tests.helpers import toy
from tests.helpers.toy import SETTINGS, numbers, words

ENDLESS = 10**9


@pytest.fixture
def start():
    """`start(command, run, *words)`: the toy's command line in a process group of its own."""
    processes = []

    def start(command, run, *more):
        line = [sys.executable, toy.__file__, command, "--run-dir", str(run), *more]
        options = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        processes.append(subprocess.Popen(line, start_new_session=True, **options))
        return processes[-1]

    yield start
    for process in processes:  # only a failed test leaves anything to kill
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


def wait_until(condition, process, seconds=120):
    limit = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.stdout.read()
        assert time.monotonic() < limit, "timed out"
        time.sleep(0.02)


def latest(run, seed):
    return checkpoint.latest_step(checkpoint_folder(run, seed)) or 0


def assert_same_state(one, other):
    def data(x):
        return jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x

    for ours, theirs in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(data(ours), data(theirs))


def test_killed_at_any_moment_and_resumed_is_as_never_killed(start, tmp_path):
    """Send SIGKILL soon after a checkpoint has appeared, when there are many writes."""
    total = 80 * 300  # long enough that a busy machine does not finish before the signal comes
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    assert main(["train", "--run-dir", str(whole), *words(total_env_steps=total)]) == 0
    more, steps = words(total_env_steps=total), []
    for delay in (0.0, 0.013, 0.031):
        process = start("train", killed, *more)
        done = steps[-1] if steps else 0
        wait_until(lambda done=done: latest(killed, 0) > done, process)
        time.sleep(delay)
        os.killpg(process.pid, signal.SIGKILL)
        text = process.communicate()[0]
        assert process.returncode == -signal.SIGKILL
        assert (f"seed 0: resuming from env step {done:,}" if done else "seed 0: fresh") in text
        steps.append(latest(killed, 0))
        more = ["--resume"]
    assert 0 < steps[0] < steps[1] < steps[2] < total
    assert main(["train", "--run-dir", str(killed), "--resume"]) == 0
    assert numbers(killed, 0) == numbers(whole, 0)
    assert_same_state(load_run(killed).state, load_run(whole).state)
    assert len(json.loads((killed / "run.json").read_text())["resumed"]) == 3


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
        stops = iter([False] * updates + [True])
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
    # Asked before every stretch of 40 env steps: the third time for 0 and 1, the second for 2.
    assert set(train(parts, [0, 1], [False, False, True]).values()) == {"interrupted"}
    assert train(parts, [2], [False, True]) == {2: "interrupted"}
    assert [latest(parts, seed) for seed in range(3)] == [80, 80, 40]
    assert set(train(parts, [0, 1, 2], []).values()) == {"finished"}
    for seed in range(3):
        assert numbers(parts, seed) == numbers(whole, seed)
        assert_same_state(load_run(parts, seed).state, load_run(whole, seed).state)


def test_ctrl_c_saves_and_says_how_to_go_on(start, tmp_path):
    run = tmp_path / "run"
    process = start("train", run, *words(total_env_steps=ENDLESS))
    wait_until(lambda: latest(run, 0) > 0, process)
    os.killpg(process.pid, signal.SIGINT)
    text = process.communicate(timeout=60)[0]
    assert process.returncode == 130
    assert (
        f"interrupted; to continue: python -m hmasd_jax.train train --run-dir {run} --resume"
        in text
    )
    assert "Traceback" not in text
    assert numbers(run, 0)[-1]["env_steps"] == latest(run, 0)


@pytest.mark.skipif(len(available_cores()) < 2, reason="two workers need two cores")
def test_workers_outlive_one_of_them_and_save_on_ctrl_c(start, tmp_path):
    run = tmp_path / "run"
    process = start("seed_sweep", run, *words(total_env_steps=ENDLESS, num_seeds=2))
    wait_until(lambda: latest(run, 0) > 0 and latest(run, 1) > 0, process)
    workers = children_of(process)
    os.kill(workers[0], signal.SIGKILL)
    steps = [latest(run, seed) for seed in (0, 1)]
    wait_until(lambda: any(latest(run, s) > steps[s] + 400 for s in (0, 1)), process)
    os.killpg(process.pid, signal.SIGINT)
    text = process.communicate(timeout=60)[0]
    assert process.returncode == 130, text
    failed = [s for s in (0, 1) if f"seed {s} failed: its process was killed by SIGKILL" in text]
    assert len(failed) == 1
    alive = 1 - failed[0]
    assert f"seed {alive} interrupted at env step {latest(run, alive):,}" in text
    assert numbers(run, alive)[-1]["env_steps"] == latest(run, alive)
    assert "to continue: python -m hmasd_jax.train seed_sweep" in text
    for pid in workers:
        assert not Path(f"/proc/{pid}").exists()


def children_of(process):
    """List the workers of a sweep."""
    pids = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [int(p) for p in pids if "spawn_main" in Path(f"/proc/{p}/cmdline").read_text()]


def assert_as_never_interrupted(run, seed, tmp_path):
    """Compare a seed's newest checkpoint and training metrics with a run that ends there."""
    whole, total = tmp_path / f"whole_{seed}_{latest(run, seed)}", latest(run, seed)
    settings = words(total_env_steps=total, seed_index=seed, num_seeds=4)
    assert main(["train", "--run-dir", str(whole), *settings]) == 0
    assert_same_state(load_run(run, seed).state, load_run(whole, seed).state)
    ours, theirs = (
        [record for record in numbers(r, seed) if record["kind"] == "train"] for r in (run, whole)
    )
    assert ours == theirs


@pytest.mark.skipif(len(available_cores()) < 2, reason="two workers need two cores")
def test_sigterm_to_all_processes_saves_every_seed(start, tmp_path):
    """Terminate a sweep as a scheduler does, resume it and terminate it again."""
    run, done = tmp_path / "run", [0, 0]
    more = words(total_env_steps=ENDLESS, num_seeds=4)
    for _ in range(2):
        process = start("seed_sweep", run, *more)
        wait_until(lambda done=done: all(latest(run, s) > done[s] for s in (0, 1)), process)
        os.killpg(process.pid, signal.SIGTERM)
        text = process.communicate(timeout=60)[0]
        assert process.returncode == 130, text
        assert "failed" not in text
        assert "Traceback" not in text
        done, more = [latest(run, seed) for seed in (0, 1)], ["--resume"]
        for seed in (0, 1):
            assert f"seed {seed} interrupted at env step {done[seed]:,}" in text
            assert numbers(run, seed)[-1]["env_steps"] == done[seed]
        statuses = json.loads((run / "summary.json").read_text())["seeds"].values()
        assert [seed["status"] for seed in statuses] == ["interrupted"] * 4
    for seed in (0, 1):
        assert_as_never_interrupted(run, seed, tmp_path)


def test_a_sweep_terminated_before_it_trains_is_interrupted(start, tmp_path):
    """Send SIGTERM while the workers still import JAX."""
    run = tmp_path / "run"
    process = start("seed_sweep", run, *words(num_seeds=1, layout="workers"))
    wait_until(lambda: children_of(process), process)
    os.killpg(process.pid, signal.SIGTERM)
    text = process.communicate(timeout=60)[0]
    assert process.returncode == 130, text
    assert "seed 0 interrupted" in text
    assert "Traceback" not in text


def test_a_worker_that_is_terminated_alone_saves_and_is_replaced(start, tmp_path):
    run = tmp_path / "run"
    settings = words(total_env_steps=ENDLESS, num_seeds=2, layout="workers")
    cores = available_cores()
    os.sched_setaffinity(0, cores[:1])  # One core, hence one worker, while seed 1 waits.
    try:
        process = start("seed_sweep", run, *settings)
    finally:
        os.sched_setaffinity(0, cores)
    wait_until(lambda: latest(run, 0) > 0, process)
    os.kill(children_of(process)[0], signal.SIGTERM)
    wait_until(lambda: latest(run, 1) > 0, process)
    os.killpg(process.pid, signal.SIGTERM)
    text = process.communicate(timeout=60)[0]
    assert process.returncode == 130, text
    assert f"seed 0 interrupted at env step {latest(run, 0):,}" in text
    assert numbers(run, 0)[-1]["env_steps"] == latest(run, 0)
    assert "failed" not in text


def test_workers_stop_when_the_parent_is_gone(start, tmp_path):
    run = tmp_path / "run"
    process = start("seed_sweep", run, *words(total_env_steps=ENDLESS, num_seeds=1))
    wait_until(lambda: latest(run, 0) > 0, process)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    process.kill()
    process.communicate()
    limit = time.monotonic() + 60
    while any(Path(f"/proc/{pid}").exists() for pid in children):
        assert time.monotonic() < limit
        time.sleep(0.1)
    assert numbers(run, 0)[-1]["env_steps"] == latest(run, 0)


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
    # the same value, said again, is no other configuration
    assert main([*command, "--algorithm.scale", "1"]) == 0


def test_a_finished_run_can_be_trained_further_and_with_more_seeds(finished, tmp_path, capsys):
    further = ["--total-env-steps", "320", "--num-seeds", "2", "--layout", "map"]
    assert main(["seed_sweep", "--run-dir", str(finished), "--resume", *further]) == 0
    at_once = tmp_path / "at_once"
    settings = words(total_env_steps=320, num_seeds=2, layout="map")
    assert main(["seed_sweep", "--run-dir", str(at_once), *settings]) == 0
    for seed in range(2):
        assert numbers(finished, seed) == numbers(at_once, seed)
        states = [load_run(run, seed).state for run in (finished, at_once)]
        assert_same_state(*states)
    capsys.readouterr()
    less = ["--resume", "--total-env-steps", "160"]
    assert main(["train", "--run-dir", str(finished), *less]) == 2
    assert "total_env_steps 320, which can be raised but not lowered" in capsys.readouterr().err


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
