"""Processes that share a search, as `tune` starts them."""

import os
import re
import signal

import pytest

from hmasd_jax.runs import metrics_log
from hmasd_jax.runs.folder import metrics_path
from hmasd_jax.search.study import read_search
from tests.helpers.processes import latest, wait_until
from tests.helpers.toy import words

pytest.importorskip("optuna")


def test_two_processes_share_a_search_and_one_continues_what_the_other_left(start, tmp_path):
    """Kill one of two processes in a trial; the other one takes it up and loses nothing."""
    folder = tmp_path / "s"
    more = [
        *words(total_env_steps=8_000, eval_interval=800, num_seeds=1, placement="vmap"),
        *("--vary", "algorithm.ppo.clip_epsilon=0.1:0.3", "--trials", "3", "--prune-after", "9"),
    ]
    one, two = (start("tune", folder, *more) for _ in range(2))

    def is_within_a_trial(process):
        """Return whether the trial under way has a checkpoint, and more than half of it to go."""
        trials = trials_of(process)
        return bool(trials) and 0 < latest(folder / f"trial_{trials[-1]}", 0) < 4_000

    wait_until(lambda: trials_of(two) and is_within_a_trial(one), one)
    os.killpg(one.pid, signal.SIGKILL)
    one.wait(timeout=60)
    killed = trials_of(one)[-1]
    text = two.output(timeout=120)
    assert two.returncode == 0, text
    assert killed in trials_of(two)
    assert "seed 0: resuming from env step" in text
    assert [trial.state.name for trial in read_search(folder).study.get_trials()] == [
        "COMPLETE"
    ] * 3
    for number in range(3):
        steps = [
            record["env_steps"]
            for record in metrics_log.read(metrics_path(folder / f"trial_{number}", 0))
            if record["kind"] == "eval"
        ]
        assert steps == list(range(0, 8_001, 800))


def trials_of(process):
    """List the trials that a process has announced."""
    return [int(number) for number in re.findall(r"trial (\d) of 3", process.log.read_text())]
