"""The documentation site builds without a warning, and needs no other server."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    for package in ("mkdocs", "material", "mkdocstrings"):
        pytest.importorskip(package, reason="the site needs the extra `docs`")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", out]
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=quiet, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def test_pages_outside_docs_are_part_of_it(site):
    home = (site / "index.html").read_text()
    assert 'href="equations.html"' in home
    assert 'src="repository/results/alice_and_bob/compared.png"' in home
    assert (site / "repository/results/alice_and_bob/compared.png").exists()
    contributing = (site / "contributing.html").read_text()
    for link in ("guides/architecture.html", "repository/scripts/site_hooks.py.html"):
        assert f'href="{link}"' in contributing
        assert (site / link).exists()


def test_links_to_code_lead_to_the_reference(site):
    page = (site / "guides" / "architecture.html").read_text()
    assert 'href="../reference/hmasd_jax.rl.html#hmasd_jax.rl.gae"' in page
    reference = (site / "reference" / "hmasd_jax.rl.html").read_text()
    assert 'id="hmasd_jax.rl.gae.normalize_advantage"' in reference


def test_links_to_other_files_lead_to_pages_with_them(site):
    page = (site / "repository/configs/alice_and_bob/hmasd.toml.html").read_text()
    assert "alice_and_bob" in page
    listing = (site / "repository/configs/index.html").read_text()
    assert 'href="overcooked/index.html"' in listing


def test_no_page_asks_another_server(site):
    for page in site.rglob("*.html"):
        found = re.findall(r'(?:src|<link[^>]*href)="(?:https?:)?//[^"]+"', page.read_text())
        assert not found, page
