"""Runs in processes of their own, and what they leave."""

import subprocess
import time
from pathlib import Path

import jax
import numpy as np

from hmasd_jax.runs import checkpoint
from hmasd_jax.runs.folder import checkpoint_folder


class LoggedProcess(subprocess.Popen):
    """A process that writes its output to a file, unless its options say where else.

    A pipe that nobody reads fills up, and then stops the process.
    """

    def __init__(self, command: list[str], log: Path, **options):
        self.log = log
        with log.open("w") as file:
            streams = {"stdout": file, "stderr": subprocess.STDOUT}
            super().__init__(command, **streams | options)

    def output(self, timeout=60):
        """Wait until the process ends, and return its output."""
        self.wait(timeout)
        return self.log.read_text()


def wait_until(condition, process, seconds=120):
    """Wait for a condition while a process runs."""
    limit = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.log.read_text()
        assert time.monotonic() < limit, "timed out"
        time.sleep(0.02)


def latest(run, seed):
    """Return the environment steps of the newest checkpoint, 0 if there is none."""
    return checkpoint.latest_step(checkpoint_folder(run, seed)) or 0


def children_of(process):
    """List the workers of a sweep."""
    pids = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [int(pid) for pid in pids if "spawn_main" in command_of(pid)]


def command_of(pid):
    """Return the command line of a process, or nothing if it has ended meanwhile."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return ""


def assert_same_state(one, other):
    """Compare two train states bit for bit."""

    def data(x):
        return jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x

    for ours, theirs in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(data(ours), data(theirs))
