"""The project's own promises: clean code, a README that says what CI runs."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = ("src", "envs_jax", "scripts", "benchmarks", "tests")
NOUN_CLAUSES = {"What", "Where", "Of", "How", "As", "By", "Which", "Who", "Why"}
"""Words with which no docstring begins: it names the thing, or says what to do."""


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


def docstrings(source):
    """Yield line and text of all docstrings, those of attributes included."""
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        for part in body if isinstance(body, list) else []:
            if isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant):
                yield part.lineno, str(part.value.value)


def test_docstrings_do_not_begin_with_noun_clauses():
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for folder in SOURCES
        for path in (ROOT / folder).rglob("*.py")
        for line, text in docstrings(path.read_text())
        if NOUN_CLAUSES.intersection(text.split()[:1])
    ]
    assert found == []
