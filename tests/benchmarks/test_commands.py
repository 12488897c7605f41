"""Benchmarks run and print their rows; speed itself is not tested."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
KEYS = {
    "name", "env", "algorithm", "seeds", "layout", "env_steps_per_s", "env_steps_per_cpu_s",
    "gflops", "ceiling_gflops", "compile_s", "peak_rss_mb",
}  # fmt: skip


def run(script, *words):
    """Rows that a benchmark prints in its quick mode."""
    command = [sys.executable, f"benchmarks/{script}", "--quick", "--repeats", "1", "--json"]
    done = subprocess.run([*command, *words], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    for row in rows:
        assert set(row) >= KEYS
    return rows


def test_environments():
    (row,) = run("environments.py")
    assert row["env"] == "alice_and_bob"
    assert row["env_steps_per_s"] > 0
    assert row["peak_rss_mb"] > 1
    assert row["gflops"] is None


def test_training_is_split_into_its_parts():
    everything = run("training.py")
    compiled, rows = everything[:3], everything[3:]
    assert [row["name"] for row in compiled] == ["init, all cores", "update, all cores", "init"]
    assert all(row["compile_s"] > 0 for row in compiled)
    assert [row["name"] for row in rows] == [
        "update", "rollout", "coordinator", "discoverer", "discriminators",
    ]  # fmt: skip
    assert all(row["gflops"] > 0 and row["ceiling_gflops"] > 0 for row in rows)
    # The parts, each measured alone, are most of the whole.
    seconds = [1 / row["env_steps_per_cpu_s"] for row in rows]
    assert 0.2 < sum(seconds[1:]) / seconds[0] < 5


def test_seeds_in_every_layout():
    rows = run("seeds.py", "--seeds", "2", "--layout", "workers", "sharded")
    assert [(row["layout"], row["seeds"]) for row in rows] == [("workers", 2), ("sharded", 2)]


def test_growth_draws_what_it_measured(tmp_path):
    (row,) = run("growth.py", "--out", str(tmp_path / "growth.png"))
    assert row["name"] == "num_agents 3"
    assert (tmp_path / "growth.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="needs the repository's history")
def test_versions_of_this_repository():
    rows = run("versions.py", "HEAD", ".", "--algorithm", "mappo")
    assert rows[0]["ratio"] == 1
    assert rows[1]["name"].startswith("this checkout")
    for row in rows:
        assert row["algorithm"] == "mappo"
        assert row["env_steps_per_cpu_s"] > 0
        assert row["compile_s"] > 0
    first, second = (row["env_steps_per_cpu_s"] for row in rows)
    low, high = rows[1]["ratio_interval"]
    assert low == rows[1]["ratio"] == high  # of a single round
    assert high == pytest.approx(second / first)


@pytest.mark.skipif(importlib.util.find_spec("jaxmarl") is None, reason="needs the extra `compare`")
def test_compare_with_jaxmarl():
    ours, theirs = run("compare.py")
    assert ours["name"] == "overcooked cramped_room, 2 copies"
    assert theirs["name"] == "JaxMARL overcooked cramped_room, 2 copies"


def test_page_shows_what_was_recorded(monkeypatch, tmp_path):
    from benchmarks import record_performance

    page = tmp_path / "performance.md"
    page.write_text(record_performance.PAGE.read_text())
    monkeypatch.setattr(record_performance, "PAGE", page)
    record_performance.write_page()
    assert page.read_text() == (ROOT / "docs" / "performance.md").read_text()


def test_matmul_flops_by_hand():
    import jax
    import jax.numpy as jnp

    from benchmarks.flops import matmul_flops

    w = jnp.ones((3, 5))

    def loop(x):  # four rounds of (2, 3) @ (3, 5): 2 * 2 * 3 * 5 each
        return jax.lax.scan(lambda c, _: (c, (c @ w).sum()), x, None, length=4)

    x = jnp.ones((2, 3))
    assert matmul_flops(loop, x) == 4 * 60
    assert matmul_flops(jax.grad(lambda x: (x @ w).sum()), x) == 2 * 60

    def either(x):  # counted as the cheaper branch
        return jax.lax.cond(x[0, 0] > 0, lambda x: (x @ w).sum(), lambda x: x.sum(), x)

    assert matmul_flops(either, x) == 0
