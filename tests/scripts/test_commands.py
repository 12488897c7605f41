"""Scripts start from the repository root and explain themselves."""

import subprocess
import sys

import pytest

from scripts.records import ROOT

SCRIPTS = [
    "battle_tactics",
    "comparison",
    "lost_battles",
    "random_play",
    "record_result",
    "record_tried",
    "skill_accuracy",
    "skill_actions",
    "soup_times",
]


@pytest.mark.parametrize("name", SCRIPTS)
def test_help(name):
    script = f"scripts/{name}.py"
    done = subprocess.run(
        [sys.executable, script, "--help"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert f"usage: {name}.py" in done.stdout
    assert f"\npython {script} " in (ROOT / script).read_text()
