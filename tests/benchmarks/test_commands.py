"""Benchmarks run and print their rows; speed itself is not tested."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import growth, maser, seeds, training, versions
from benchmarks.time_to_solve import Curve, have_learned, measured, recorded, solve
from tests.helpers.runs import write_run

ROOT = Path(__file__).parents[2]
KEYS = {
    "name", "env", "algorithm", "seeds", "placement", "env_steps_per_s", "env_steps_per_cpu_s",
    "gflops", "ceiling_gflops", "compile_s", "peak_rss_mb",
}  # fmt: skip


QUICK = ("--quick", "--repeats", "1", "--json")


def rows_in(text):
    """Rows that a benchmark printed."""
    rows = [json.loads(line) for line in text.splitlines()]
    for row in rows:
        assert set(row) >= KEYS
    return rows


def run(script, *words):
    """Rows of a benchmark that runs in processes of its own."""
    command = [sys.executable, f"benchmarks/{script}", *QUICK, *words]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return rows_in(done.stdout)


@pytest.fixture
def run_here(monkeypatch, capsys):
    """`run_here(module, *words)`: rows of a benchmark that measures in this process."""

    def run_here(module, *words):
        monkeypatch.setattr(sys, "argv", [module.__file__, *QUICK, *words])
        call = lambda function, *args, core=None: function(*args)  # noqa: E731
        monkeypatch.setattr(module, "isolated", call, raising=False)
        monkeypatch.setattr(module, "pin", lambda core: None, raising=False)
        module.main()
        return rows_in(capsys.readouterr().out)

    return run_here


def test_seeds_that_have_learned():
    assert have_learned([0.0, 0.05, 0.2, 1.0]) == [False, False, True, True]
    assert have_learned([0.0, 0.004, 0.012]) == [False, False, False]
    assert have_learned([20.0, 1.9]) == [True, False]


def test_environments():
    (row,) = run("environments.py")
    assert row["env"] == "alice_and_bob"
    assert row["env_steps_per_s"] > 0
    assert row["peak_rss_mb"] > 1
    assert row["gflops"] is None


def test_training_is_split_into_its_parts(run_here):
    everything = run_here(training)
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


def test_seeds_in_workers_and_in_one_program(run_here):
    words = ("--algorithm", "mappo", "--seeds", "2", "--placement")
    rows = run_here(seeds, *words, "workers") + run("seeds.py", *words, "sharded")
    assert [(row["placement"], row["seeds"]) for row in rows] == [("workers", 2), ("sharded", 2)]


def test_growth_draws_what_it_measured(run_here, tmp_path):
    (row,) = run_here(growth, "--out", str(tmp_path / "growth.png"))
    assert row["name"] == "num_agents 3"
    assert (tmp_path / "growth.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="needs the repository's history")
def test_versions_of_this_repository(run_here):
    rows = run_here(versions, "HEAD", ".", "--algorithm", "mappo")
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


def test_maser_beside_a_process_that_answers_half_a_second(run_here, tmp_path):
    original = tmp_path / "python"
    original.write_text("#!/bin/sh\nwhile read line; do echo 0.5; done\n")
    original.chmod(0o755)
    theirs, ours = run_here(maser, "--python", str(original), "--checkout", "none")
    assert (theirs["name"], ours["name"]) == ("original", "hmasd_jax")
    assert theirs["env_steps_per_cpu_s"] == 60 / 0.5  # steps of the longest battle in 3m
    assert ours["ratio"] == pytest.approx(ours["env_steps_per_cpu_s"] / 120)


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


def test_time_to_solve_by_hand():
    """The last five of 1, 1, 1, 1, 0.8 are 0.96 on average, of which 90 % is 0.864."""
    steps, seconds = [0, 10, 20, 30, 40, 50, 60], [0, 60, 120, 180, 240, 300, 360]
    fast = Curve(steps, [0, 0.86, 1, 1, 1, 1, 0.8], seconds)
    slow = Curve(steps, [0, 0, 0, 0, 0.5, 0.5, 1], seconds)  # final level 0.4, reached at 40
    never = Curve(steps, [0, 0, 0, 0, 0, 0, 0.1], seconds)
    row = solve("x", [fast, slow, never])
    assert row[:3] == ("x", 3, 2)
    assert row[3:] == pytest.approx(((0.96 + 0.4) / 2, 30, 3.0, 4.0))
    assert solve("x", [Curve(steps, [0] * 7, seconds)])[1:] == (1, 0, None, None, None, None)


def test_every_result_recorded_on_a_cpu_has_a_time_to_solve():
    rows = {row.name: row for row in recorded()}
    assert "alice_and_bob/hmasd" not in rows  # Its seeds share a GPU.
    assert rows["alice_and_bob/hmasd_robust"].learned == 10
    assert not rows["alice_and_bob/mappo"].learned
    assert all(row.core_minutes > 0 for row in rows.values() if row.learned)


def test_time_to_solve_of_a_run(tmp_path):
    run = write_run(tmp_path / "run", [[0.0, 0.6, 0.5, 1.0]])
    # The level is (0.6 + 0.5 + 1) / 3 = 0.7, of which 90 % is 0.63. With the untrained policy's 0
    # it would be 0.525, and 0.6 would be enough.
    row = measured(run)
    assert (row.level, row.env_steps) == (pytest.approx(0.7), 300)
