"""Commands that are told to be typed next."""

import os
import shutil
import sys
from pathlib import Path

import pytest

from hmasd_jax.cli.hints import shell_command, write_command


@pytest.fixture
def environment(tmp_path, monkeypatch):
    """An environment of Python in the current folder, which is active if `PATH` has it."""
    python = tmp_path / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.symlink_to(sys.executable)
    monkeypatch.setattr(sys, "executable", str(python))
    monkeypatch.chdir(tmp_path)
    return python


def test_an_active_environment_has_its_python_by_name(environment, monkeypatch):
    monkeypatch.setenv("PATH", str(environment.parent), prepend=os.pathsep)
    assert write_command("plot", "a run") == "python -m hmasd_jax.train plot 'a run'"


def test_without_an_active_environment_the_path_of_its_python_is_told(
    environment, tmp_path, monkeypatch
):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert shutil.which("python") is None
    assert write_command("plot") == ".venv/bin/python -m hmasd_jax.train plot"
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert write_command("plot") == f"{environment} -m hmasd_jax.train plot"


def test_another_python_of_that_name_is_not_told(environment, tmp_path, monkeypatch):
    other = tmp_path / "other" / "python"
    other.parent.mkdir()
    other.symlink_to(Path(environment).resolve())
    monkeypatch.setenv("PATH", str(other.parent))
    assert write_command("plot").startswith(".venv/bin/python ")


def test_records_name_python_alone():
    assert shell_command("train")[0] == "python"
