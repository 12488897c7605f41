"""Signals to a run, to all of its processes or to one of them, lose nothing."""

import json
import os
import pty
import signal
import time
from pathlib import Path

import pytest

from hmasd_jax.cli.main import main
from hmasd_jax.runs.folder import available_cores
from hmasd_jax.runs.load import load_run
from tests.helpers import toy
from tests.helpers.processes import assert_same_state, children_of, latest, wait_until
from tests.helpers.toy import numbers, words

ENDLESS = 10**9


@pytest.fixture(autouse=True)
def hang_up_is_not_ignored():
    """Let SIGHUP end processes. Under nohup the tests would pass on that it is ignored."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


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
        text = process.output()
        assert process.returncode == -signal.SIGKILL
        assert (f"seed 0: resuming from env step {done:,}" if done else "seed 0: fresh") in text
        steps.append(latest(killed, 0))
        more = ["--resume"]
    assert 0 < steps[0] < steps[1] < steps[2] < total
    assert main(["train", "--run-dir", str(killed), "--resume"]) == 0
    assert numbers(killed, 0) == numbers(whole, 0)
    assert_same_state(load_run(killed).state, load_run(whole).state)
    assert len(json.loads((killed / "run.json").read_text())["resumed"]) == 3


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_saves_and_says_how_to_go_on(number, start, tmp_path):
    """Press Ctrl-C, or end the connection."""
    run = tmp_path / "run"
    process = start("train", run, *words(total_env_steps=ENDLESS))
    wait_until(lambda: latest(run, 0) > 0, process)
    os.killpg(process.pid, number)
    text = process.output()
    assert process.returncode == 130
    assert f"interrupted; to continue: python {toy.__file__} train --run-dir {run} --resume" in text
    assert "Traceback" not in text
    assert numbers(run, 0)[-1]["env_steps"] == latest(run, 0)


@pytest.mark.parametrize(
    ("open_ends", "number"),
    [(os.pipe, signal.SIGINT), (os.pipe, None), (pty.openpty, signal.SIGHUP)],
)
def test_output_that_nobody_reads_loses_nothing(open_ends, number, start, tmp_path):
    """End the reader, as Ctrl-C ends `tee`, or the terminal, and send a signal or none."""
    run = tmp_path / "run"
    total = 80 * 300 if number is None else ENDLESS
    read, write = open_ends()
    process = start("train", run, *words(total_env_steps=total), stdout=write, stderr=write)
    os.close(write)
    wait_until(lambda: latest(run, 0) > 0, process)
    os.close(read)
    if number is not None:
        os.killpg(process.pid, number)
    assert process.wait(60) == (0 if number is None else 130)
    assert numbers(run, 0)[-1]["env_steps"] == latest(run, 0)
    (status,) = json.loads((run / "summary.json").read_text())["seeds"].values()
    assert status["status"] == ("finished" if number is None else "interrupted")


def test_a_run_under_nohup_outlives_its_connection(start, tmp_path):
    run = tmp_path / "run"
    settings = words(total_env_steps=80 * 300, num_seeds=1, placement="workers")
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # The process inherits it.
    try:
        process = start("seed_sweep", run, *settings)
    finally:
        signal.signal(signal.SIGHUP, before)
    wait_until(lambda: latest(run, 0) > 0, process)
    os.killpg(process.pid, signal.SIGHUP)
    text = process.output()
    assert process.returncode == 0, text


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
    text = process.output()
    assert process.returncode == 130, text
    failed = [s for s in (0, 1) if f"seed {s} failed: its process was killed by SIGKILL" in text]
    assert len(failed) == 1
    alive = 1 - failed[0]
    assert f"seed {alive} interrupted at env step {latest(run, alive):,}" in text
    assert numbers(run, alive)[-1]["env_steps"] == latest(run, alive)
    assert f"to continue: python {toy.__file__} seed_sweep" in text
    for pid in workers:
        assert not Path(f"/proc/{pid}").exists()


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
def test_sigterm_or_sighup_to_all_processes_saves_every_seed(start, tmp_path):
    """Terminate a sweep as a scheduler does, resume it and end the connection."""
    run, done = tmp_path / "run", [0, 0]
    more = words(total_env_steps=ENDLESS, num_seeds=4)
    for number in (signal.SIGTERM, signal.SIGHUP):
        process = start("seed_sweep", run, *more)
        wait_until(lambda done=done: all(latest(run, s) > done[s] for s in (0, 1)), process)
        os.killpg(process.pid, number)
        text = process.output()
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
    process = start("seed_sweep", run, *words(num_seeds=1, placement="workers"))
    wait_until(lambda: children_of(process), process)
    os.killpg(process.pid, signal.SIGTERM)
    text = process.output()
    assert process.returncode == 130, text
    assert "seed 0 interrupted" in text
    assert "Traceback" not in text


def test_a_worker_that_is_terminated_alone_saves_and_is_replaced(start, tmp_path):
    run = tmp_path / "run"
    settings = words(total_env_steps=ENDLESS, num_seeds=2, placement="workers")
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
    text = process.output()
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
    process.wait()
    limit = time.monotonic() + 60
    while any(Path(f"/proc/{pid}").exists() for pid in children):
        assert time.monotonic() < limit
        time.sleep(0.1)
    assert numbers(run, 0)[-1]["env_steps"] == latest(run, 0)
