"""The project's own promises: clean code, a README that says what CI runs."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("command", ["ruff check", "ruff format --check", "pyrefly check"])
def test_code_is_clean(command: str):
    tool = Path(sys.executable).with_name(command.split()[0])
    arguments = command.split()[1:]
    if tool.name == "pyrefly":
        arguments += ["--python-interpreter-path", sys.executable]
    done = subprocess.run([tool, *arguments], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_readme_gives_the_test_command_of_ci():
    command = (ROOT / ".ci" / "run").read_text().splitlines()[-1]
    assert "pytest" in command
    assert command in (ROOT / "README.md").read_text().splitlines()


def test_environments_import_nothing_of_the_trainer():
    code = (
        "import sys, envs_jax; "
        "loaded = {name.split('.')[0] for name in sys.modules}; "
        "assert not loaded & {'hmasd_jax', 'distrax', 'flax', 'optax'}, loaded"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
