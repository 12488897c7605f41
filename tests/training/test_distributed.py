"""A sweep over two processes on this machine, connected by JAX's runtime."""

import json
import os
import socket
import subprocess
import sys

import pytest

from hmasd_jax.cli.main import main
from hmasd_jax.runs.folder import available_cores, seeds_of
from hmasd_jax.training.distributed import share_of_cores
from tests.helpers import toy
from tests.helpers.toy import numbers, words

TOY, WORDS = toy.__file__, words()


@pytest.fixture
def sweep():
    """`sweep(run, *words)`: two processes of one sweep; their exit codes and outputs."""
    processes = []

    def sweep(run, *words):
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
        outputs = [process.communicate(timeout=120) for process in processes]
        return [process.returncode for process in processes], outputs

    yield sweep
    for process in processes:
        process.kill()


@pytest.mark.parametrize("layout", ["workers", "vmap"])
def test_two_processes_share_the_seeds_and_make_one_run(layout, sweep, tmp_path):
    run = tmp_path / "run"
    codes, ((out, err), (quiet, _)) = sweep(run, *WORDS, "--layout", layout)
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
