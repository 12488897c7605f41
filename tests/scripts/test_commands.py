"""Scripts start from the repository root and explain themselves."""

import runpy
import subprocess
import sys

import pytest

from scripts.records import ROOT

SCRIPTS = sorted(
    path.stem for path in (ROOT / "scripts").glob("*.py") if "__main__" in path.read_text()
)


@pytest.mark.parametrize("name", SCRIPTS)
def test_help(name, monkeypatch, capsys):
    script = f"scripts/{name}.py"
    monkeypatch.setattr(sys, "argv", [script, "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(ROOT / script), run_name="__main__")
    assert not end.value.code
    assert f"usage: {name}.py" in capsys.readouterr().out
    assert f"\npython {script} " in (ROOT / script).read_text()


def test_a_script_finds_what_it_imports():
    command = [sys.executable, f"scripts/{SCRIPTS[0]}.py", "--help"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
