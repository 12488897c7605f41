"""The pages of the project are true: code runs, links lead somewhere, and names exist.

A code block that begins with "python needs PACKAGE" is skipped where that package is not installed.
"""

import importlib.util
import pydoc
import re
import shlex
from pathlib import Path

import pytest

from envs_jax import registry
from hmasd_jax.algorithms import ALGORITHMS
from hmasd_jax.cli.main import COMMANDS
from hmasd_jax.cli.options import GridOptions, RunOptions, TuneOptions
from hmasd_jax.cli.parse import load_config, parse
from hmasd_jax.cli.vary import split_settings
from hmasd_jax.config import change
from hmasd_jax.search.space import read_space
from tests.helpers.runs import save_checkpoint, write_run

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(DOCS.rglob("*.md"))]
BLOCK = re.compile(r"^```python(?: needs (\w+))?\n(.*?)^```$", re.DOTALL | re.MULTILINE)
ANY_BLOCK = re.compile(r"^ *```.*?^ *```$", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\(([^)\s]+)\)")
NAME = re.compile(r"`((?:hmasd_jax|envs_jax)(?:\.\w+)+)`")
FOLDERS = "benchmarks|configs|docs|envs_jax|results|scripts|src|tests"
PATH = re.compile(rf"`((?:{FOLDERS})/[\w./*{{}},-]*)`")
RUN = "runs/hmasd"
"""Run that code blocks load. It is written for them, with a policy that is not trained."""
COMMAND = re.compile(r"python -m hmasd_jax\.train ([^\n#&]+)")
HISTORY = {"CHANGELOG.md"}
"""Pages that name what is gone."""


def _name(page):
    return str(page.relative_to(ROOT))


def _with_code():
    return [page for page in PAGES if page.is_relative_to(DOCS) and BLOCK.search(page.read_text())]


@pytest.mark.filterwarnings("ignore::DeprecationWarning:jaxmarl")
@pytest.mark.parametrize("page", _with_code(), ids=_name)
def test_code_blocks_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # The environments and the algorithm that a page registers are forgotten afterwards.
    monkeypatch.setattr(registry, "ENVIRONMENTS", dict(registry.ENVIRONMENTS))
    monkeypatch.setitem(ALGORITHMS, "my_ppo", ALGORITHMS["mappo"])
    del ALGORITHMS["my_ppo"]
    text = page.read_text()
    if any(RUN in block[2] for block in BLOCK.finditer(text)):
        (tmp_path / RUN).parent.mkdir()
        run = write_run(tmp_path / RUN, [[0.0]], **{"algorithm.ppo.hidden_size": 8})
        save_checkpoint(run, seed=0, env_steps=100)
    namespace = {"__name__": page.stem}
    left_out = set()
    for block in BLOCK.finditer(text):
        package, code = block.groups()
        if package and importlib.util.find_spec(package) is None:
            left_out.add(package)
            continue
        # Blank lines in front, so that a traceback names the line of the page.
        source = "\n" * text[: block.start(2)].count("\n") + code
        exec(compile(source, page, "exec"), namespace)
    if left_out:
        pytest.skip(f"blocks that need {', '.join(left_out)}, which is not installed")


def test_pages_have_code():
    names = {_name(page) for page in _with_code()}
    stems = ("adapters", "new_algorithm", "new_environment", "running")
    guides = {f"docs/guides/{stem}.md" for stem in stems}
    tasks = ("alice_and_bob", "overcooked", "micro_battle")
    assert names >= guides | {f"docs/environments/{task}.md" for task in tasks}


def _commands(page):
    """Return the command lines of a page that need neither a package nor a shell's variables."""
    lines = [x for block in ANY_BLOCK.findall(page.read_text()) for x in COMMAND.findall(block)]
    words = (shlex.split(line) for line in lines if "$" not in line)
    return [line for line in words if "--help" not in line and "jaxmarl" not in line]


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.name not in HISTORY and _commands(page)], ids=_name
)
def test_commands_can_be_typed(page, monkeypatch):
    monkeypatch.chdir(ROOT)
    for name, *words in _commands(page):
        options, overrides = parse(COMMANDS[name].options, words)
        if not isinstance(options, RunOptions) or options.resume:
            continue
        config = load_config(options, overrides)
        if isinstance(options, GridOptions):
            assert all(change(config, cell) for cell in options.cells)
        elif isinstance(options, TuneOptions):
            read_space(config, split_settings(options.vary))


def test_commands_are_found():
    pages = {_name(page): len(_commands(page)) for page in PAGES}
    assert pages["README.md"] >= 10
    assert pages["docs/guides/running.md"] >= 10


def _anchors(page):
    """Return the anchors that GitHub gives to the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", ANY_BLOCK.sub("", page.read_text()), re.MULTILINE)
    words = [re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings]
    return {heading.strip().replace(" ", "-") for heading in words}


def _broken_links(page):
    broken = []
    for link in LINK.findall(ANY_BLOCK.sub("", page.read_text())):
        if re.match(r"\w+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if not target.exists() or (anchor and anchor not in _anchors(target)):
            broken.append(link)
    return broken


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_lead_somewhere(page):
    assert not _broken_links(page)


def test_broken_links_are_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# A page\n[a](page.md#a-page) [b](https://b.org) [c](c.md) ![d](#d)\n")
    assert _broken_links(page) == ["c.md", "#d"]


def _exists(path):
    """Return whether a path of the repository, which may hold * or {a,b}, stands for a file."""
    choice = re.search(r"{([\w,]+)}", path)
    if choice:
        return all(_exists(path.replace(choice[0], part, 1)) for part in choice[1].split(","))
    return any(ROOT.glob(path)) if "TASK" not in path else True


@pytest.mark.parametrize("page", [page for page in PAGES if page.name not in HISTORY], ids=_name)
def test_names_and_paths_exist(page):
    text = ANY_BLOCK.sub("", page.read_text())
    assert not [name for name in NAME.findall(text) if pydoc.locate(name) is None]
    assert not [path for path in PATH.findall(text) if not _exists(path)]
