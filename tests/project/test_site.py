"""The documentation site builds without a warning, and needs no other server."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
REFERENCE = "reference/hmasd_jax.rl.html"
LINKS = {
    "index.html": ["equations.html", "contributing.html", "reference/envs_jax.probes.html"],
    "contributing.html": ["guides/architecture.html", "repository/scripts/site_hooks.py.html"],
    "guides/architecture.html": [f"../{REFERENCE}", "new_algorithm.html"],
    "guides/running.html": ["../repository/configs/index.html", "skill_data.ipynb"],
    "repository/configs/index.html": ["overcooked/index.html"],
    "results.html": ["repository/results/alice_and_bob/hmasd.json"],
}
"""Pages, and some of what they link."""


def test_the_site_builds_and_is_whole(tmp_path):
    for package in ("mkdocs", "material", "mkdocstrings"):
        pytest.importorskip(package, reason="the site needs the extra `docs`")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"]
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        [*command, "--site-dir", tmp_path], cwd=ROOT, env=quiet, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    for page, links in LINKS.items():
        text = (tmp_path / page).read_text()
        for link in links:
            assert re.search(rf'href="{re.escape(link)}["#]', text), (page, link)
            assert (tmp_path / page).parent.joinpath(link).exists()
    picture = "repository/results/alice_and_bob/presets.png"
    assert f'src="{picture}"' in (tmp_path / "index.html").read_text()
    assert (tmp_path / picture).exists()
    assert 'id="hmasd_jax.rl.gae.normalize_advantage"' in (tmp_path / REFERENCE).read_text()
    for page in tmp_path.rglob("*.html"):
        assert not re.search(r'(?:src|<link[^>]*href)="(?:https?:)?//[^"]+"', page.read_text()), (
            page
        )
