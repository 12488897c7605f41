"""A real HMASD run that is killed at random moments, by hand because it takes minutes.

Run it with the number of kills: `HMASD_JAX_KILLS=100 pytest tests/training/test_random_kills.py`.
"""

import os
import random
import signal
import subprocess
import sys
import time

import pytest

from hmasd_jax.runs.load import load_run
from tests.conftest import FLAGS
from tests.helpers.processes import assert_same_state, latest
from tests.helpers.toy import numbers

KILLS = int(os.environ.get("HMASD_JAX_KILLS", 0))
PER_UPDATE = 3_200


@pytest.mark.skipif(KILLS == 0, reason="takes minutes; HMASD_JAX_KILLS is the number of kills")
def test_hmasd_killed_at_random_moments_and_resumed_is_as_never_killed(tmp_path):
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    rng, kills, resumes, moments = random.Random(0), 0, False, []
    # The first run compiles, for which no process of the loop would live long enough. The second
    # gives the longest time from start to kill: half of it is imports and loading the programs.
    assert train(tmp_path / "compiled", PER_UPDATE, resumes=False).wait() == 0
    start = time.monotonic()
    assert train(tmp_path / "timed", 12 * PER_UPDATE, resumes=False).wait() == 0
    longest = time.monotonic() - start
    while kills < KILLS:
        total = latest(killed, 0) + 40 * PER_UPDATE
        process = train(killed, total, resumes)
        try:
            process.wait(timeout=rng.uniform(0.0, longest))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            kills += 1
            moments.append(latest(killed, 0))
        else:
            assert process.returncode == 0
        resumes = (killed / "run.json").exists()
    assert train(killed, total, resumes).wait() == 0
    assert train(whole, total, resumes=False).wait() == 0
    print(f"{kills} kills, at {len(set(moments))} checkpoints, in {total // PER_UPDATE} updates")
    assert len(set(moments)) > KILLS / 5
    assert numbers(killed, 0) == numbers(whole, 0)
    assert_same_state(load_run(killed).state, load_run(whole).state)


def train(run, total_env_steps, resumes):
    """Start the paper's HMASD as a user would, with a checkpoint after every update."""
    settings = {
        "--checkpoint-interval": PER_UPDATE,
        "--log-interval": PER_UPDATE,
        "--eval-interval": 8 * PER_UPDATE,
        "--eval-episodes": 10,
    }
    options = ["--resume"] if resumes else [str(x) for pair in settings.items() for x in pair]
    line = [sys.executable, "-m", "hmasd_jax.train", "train", "--run-dir", str(run), *options]
    env = {k: v for k, v in os.environ.items() if k != "JAX_DISABLE_MOST_OPTIMIZATIONS"}
    env["XLA_FLAGS"] = env["XLA_FLAGS"].replace(FLAGS, "")
    return subprocess.Popen(
        [*line, "--total-env-steps", str(total_env_steps)],
        env=env, start_new_session=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip
