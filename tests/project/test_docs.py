"""The code on the pages under docs/ runs, block after block, as a reader would type it.

A block that begins with "python needs PACKAGE" is left out where that package is not installed.
"""

import importlib.util
import re
from pathlib import Path

import pytest

from envs_jax import registry

DOCS = Path(__file__).parents[2] / "docs"
BLOCK = re.compile(r"^```python(?: needs (\w+))?\n(.*?)^```$", re.DOTALL | re.MULTILINE)
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if BLOCK.search(page.read_text())]


@pytest.mark.filterwarnings("ignore::DeprecationWarning:jaxmarl")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_code_blocks_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # What a page registers is forgotten afterwards.
    monkeypatch.setattr(registry, "ENVIRONMENTS", dict(registry.ENVIRONMENTS))
    text = page.read_text()
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
    assert {page.stem for page in PAGES} >= {"new_algorithm", "new_environment"}
