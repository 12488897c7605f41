import os
import signal
import sys

import pytest

from tests.helpers import toy
from tests.helpers.processes import LoggedProcess


@pytest.fixture
def start(tmp_path):
    """`start(command, run, *words, **options)`: the toy's command line in a process group.

    The options are those of `subprocess.Popen`.
    """
    processes = []

    def start(command, run, *more, **options):
        line = [sys.executable, toy.__file__, command, "--run-dir", str(run), *more]
        log = tmp_path / f"output_{len(processes)}.txt"
        processes.append(LoggedProcess(line, log, start_new_session=True, **options))
        return processes[-1]

    yield start
    for process in processes:  # only a failed test leaves anything to kill
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
