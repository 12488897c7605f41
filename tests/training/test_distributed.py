"""A sweep over two processes on this machine, connected by JAX's runtime."""

import json
import os
import signal
import socket
import subprocess
import sys
import time

import jax
import pytest

from hmasd_jax.cli.main import main
from hmasd_jax.runs.folder import available_cores, seeds_of
from hmasd_jax.training import distributed
from hmasd_jax.training.distributed import Group, share_of_cores
from hmasd_jax.training.job import Event
from tests.helpers import toy
from tests.helpers.processes import latest, wait_until
from tests.helpers.toy import numbers, words

TOY, WORDS = toy.__file__, words()


@pytest.fixture
def start_two():
    """`start_two(run, *words)`: the two processes of one sweep."""
    processes = []

    def start_two(run, *words):
        with socket.socket() as free:
            free.bind(("localhost", 0))
            address = f"localhost:{free.getsockname()[1]}"
        command = [
            sys.executable,
            toy.__file__,
            "seed_sweep",
            "--distributed",
            "--run-dir",
            str(run),
        ]
        for index in range(2):
            env = os.environ | {
                "JAX_COORDINATOR_ADDRESS": address,
                "JAX_NUM_PROCESSES": "2",
                "JAX_PROCESS_ID": str(index),
            }
            options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
            processes.append(subprocess.Popen([*command, *words], env=env, **options))
        return processes

    yield start_two
    for process in processes:
        process.kill()


@pytest.fixture
def sweep(start_two):
    """`sweep(run, *words)`: two processes of one sweep; their exit codes and outputs."""

    def sweep(run, *words):
        processes = start_two(run, *words)
        outputs = [process.communicate(timeout=120) for process in processes]
        return [process.returncode for process in processes], outputs

    return sweep


@pytest.mark.parametrize("placement", ["workers", "vmap"])
def test_two_processes_share_the_seeds_and_make_one_run(placement, sweep, tmp_path):
    run = tmp_path / "run"
    codes, ((out, err), (quiet, _)) = sweep(run, *WORDS, "--placement", placement)
    assert codes == [0, 0], err
    assert seeds_of(run) == [0, 1, 2]
    assert "2 processes (this one trains and shows 0, 2)" in out
    assert "seed" not in quiet  # gloo says that it is connected
    # Each has half of the cores that both were started on.
    cores = (len(available_cores()) + 1) // 2
    assert json.loads((run / "run.json").read_text())["cores"] == cores
    # The first process sums up what both did, and leaves no notes behind.
    summary = json.loads((run / "summary.json").read_text())
    assert [summary["seeds"][str(seed)]["status"] for seed in range(3)] == ["finished"] * 3
    assert (run / "curves.png").exists()
    assert not list(run.glob("process_*"))
    # Seed 1, which the second process trained, is the same run as alone.
    alone = tmp_path / "alone"
    assert main(["train", "--run-dir", str(alone), "--seed-index", "1", *WORDS]) == 0
    assert numbers(run, 1) == numbers(alone, 1)


@pytest.mark.parametrize(
    ("places", "shares"),
    [
        ([7, 7], [[2, 5], [3]]),
        ([7, 8], [[2, 3, 5], [2, 3, 5]]),  # two machines
        ([7, 8, 7], [[2, 5], [2, 3, 5], [3]]),
        ([7] * 4, [[2], [3], [5], [2]]),  # more processes than cores
    ],
)
def test_processes_on_the_same_cores_share_them_out(places, shares):
    assert [share_of_cores([2, 3, 5], places, i) for i in range(len(places))] == shares


def test_told_to_stop_the_first_process_waits_until_the_others_have_saved(start_two, tmp_path):
    run, total = tmp_path / "run", 80 * 300
    steps = words(total_env_steps=total, num_seeds=2)
    first, second = start_two(run, *steps, "--placement", "vmap")
    wait_until(lambda: latest(run, 1) > 0, second)
    second.send_signal(signal.SIGSTOP)  # The first process ends while the second still trains.
    wait_until(lambda: latest(run, 0) == total, first)
    for process in (first, second):
        process.send_signal(signal.SIGTERM)
    time.sleep(1)
    second.send_signal(signal.SIGCONT)
    outputs = [process.communicate(timeout=60) for process in (first, second)]
    assert [first.returncode, second.returncode] == [130, 130], outputs
    assert f"to continue: python {TOY} seed_sweep" in outputs[0][0]
    seeds = json.loads((run / "summary.json").read_text())["seeds"]
    assert [seeds[seed]["status"] for seed in ("0", "1")] == ["finished", "interrupted"]
    assert 0 < latest(run, 1) == numbers(run, 1)[-1]["env_steps"] < total


def test_a_process_that_never_reports_is_given_up_once_told_to_stop(tmp_path, monkeypatch):
    monkeypatch.setattr(distributed, "POLL_SECONDS", 0)
    monkeypatch.setattr(distributed, "GRACE_SECONDS", 0.01)
    group, asked = Group(index=0, size=3), []
    distributed.gather(Group(2, 3), tmp_path, [], {2: Event("finished", 2, {})}, bool)

    def should_stop():
        asked.append(True)
        return len(asked) > 5

    mine = {0: Event("finished", 0, {}), 3: Event("finished", 3, {})}
    results = distributed.gather(group, tmp_path, list(range(5)), mine, should_stop)
    assert len(asked) > 5
    assert {seed: event.kind for seed, event in sorted(results.items())} == {
        0: "finished", 1: "failed", 2: "finished", 3: "finished", 4: "failed",
    }  # fmt: skip
    assert results[4].data == {"message": "process 1, which trains it, has not reported"}
    assert not list(tmp_path.iterdir())


def test_a_process_that_an_error_ends_is_not_waited_for(tmp_path):
    follower, leader = Group(index=1, size=2), Group(index=0, size=2)
    error = jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory\nmore")
    for group in (leader, follower):
        with (
            pytest.raises(jax.errors.JaxRuntimeError),
            distributed.telling_failure(group, tmp_path, [1, 3]),
        ):
            raise error
    results = distributed.gather(leader, tmp_path, list(range(4)), {}, bool)
    assert [(seed, event.kind) for seed, event in results.items()] == [(1, "failed"), (3, "failed")]
    assert results[1].data == {"message": "RESOURCE_EXHAUSTED: Out of memory"}


def test_when_the_first_process_refuses_all_do(sweep, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / "thesis.tex").write_text("mine")
    codes, ((_, first), (_, second)) = sweep(run, *WORDS)
    assert codes == [2, 2]
    assert "run is not empty, and not a run folder: choose another --run-dir" in first
    assert "the first process could not prepare the run" in second
    assert [path.name for path in run.iterdir()] == ["thesis.tex"]


def test_without_a_way_to_connect_one_line_says_what_to_set(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("JAX_COORDINATOR_ADDRESS", raising=False)
    assert main(["seed_sweep", "--distributed", *WORDS]) == 2
    assert "--distributed needs --run-dir" in capsys.readouterr().err
    command = [
        sys.executable,
        toy.__file__,
        "seed_sweep",
        "--distributed",
        "--run-dir",
        "run",
        *WORDS,
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert "JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID" in done.stderr
    assert not (tmp_path / "run").exists()
