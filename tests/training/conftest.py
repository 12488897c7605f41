import os
import signal
import subprocess
import sys

import pytest

from tests.helpers import toy


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
