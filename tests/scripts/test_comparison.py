"""The paper's comparison: every cell can be trained, and what is missing is told."""

import json
import shlex
from collections import Counter

import pytest

from hmasd_jax.cli.main import COMMANDS
from hmasd_jax.cli.parse import load_config, parse
from hmasd_jax.config import load
from scripts import comparison
from scripts.comparison import Cell, cells
from scripts.paper import TASKS
from scripts.records import RESULTS, ROOT

CELLS = list(cells())


@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: f"{cell.task}-{cell.name}")
def test_the_command_of_a_cell_trains_its_system(cell, monkeypatch):
    monkeypatch.chdir(ROOT)
    words = shlex.split(cell.command(3))
    options, overrides = parse(COMMANDS[words[3]].options, words[4:])
    config = load_config(options, overrides)
    assert (options.seed_index, config.num_seeds) == (3, cell.seeds)
    preset = ROOT / "configs" / cell.task / f"{cell.name.partition('_')[0]}.toml"
    assert config == load(preset, {"num_seeds": cell.seeds, **cell.overrides})
    assert str(options.run_dir) == f"runs/{cell.task.replace('/', '_')}_{cell.name}_3"
    assert cell.name in TASKS[cell.task].paper


def test_every_number_of_the_paper_has_a_cell():
    numbers = [(task, name) for task in TASKS for name in TASKS[task].paper]
    assert Counter(numbers) == Counter((cell.task, cell.name) for cell in CELLS)


def test_seeds_with_the_settings_of_today_count(monkeypatch):
    cell = Cell("alice_and_bob", "mappo", "mappo", 12, {})
    assert cell.missing() == [10, 11]
    record = json.loads((RESULTS / "alice_and_bob/mappo.json").read_text())
    record["command"] = "train --config configs/alice_and_bob/mappo.toml for I = 0,3"
    monkeypatch.setattr(comparison, "find_record", lambda *_: record)
    assert cell.missing() == [1, 2, *range(4, 12)]
    record["config"]["algorithm"]["entropy_coef"] = 0.5
    assert cell.missing() == list(range(12))
    other = cell._replace(overrides={"algorithm.entropy_coef": 0.5})
    assert other.missing() == [1, 2, *range(4, 12)]


def test_seeds_that_ended_early_are_missing_and_named(monkeypatch):
    record = json.loads((RESULTS / "alice_and_bob/mappo.json").read_text())
    record["config"]["total_env_steps"] *= 2
    record["values"] = [[0.0] * len(values) for values in record["values"]]
    record["values"][3][2] = 0.5
    monkeypatch.setattr(comparison, "find_record", lambda *_: record)
    monkeypatch.setattr(comparison, "changed_settings", lambda *_: {})
    cell = Cell("alice_and_bob", "mappo", "mappo", 10, {})
    assert cell.missing() == [3]
    shown = comparison.shown("alice_and_bob", "mappo")
    assert "9 stopped, 50% of the steps)" in shown


def test_a_cell_that_was_not_run_says_so(monkeypatch):
    monkeypatch.setattr(comparison, "find_record", lambda *_: None)
    assert comparison.shown("micro_battle/3m", "maser") == "not run<br>62"
    assert comparison.shown("micro_battle/3m", "eiti") == ""


def test_seeds_that_learned_are_counted_beside_the_papers(monkeypatch):
    record = {"metric": "success", "values": [[0.0] * 5, [0.0, 0.5, 0.0, 0.0, 0.0], [1.0] * 5]}
    records = {"alice_and_bob": record}  # The second seed has a tenth of the best.
    monkeypatch.setattr(comparison, "find_record", lambda task, _: records.get(task))
    assert comparison.learned("hmasd") == "2 of 3<br>26 of 35"
    assert comparison.learned("mappo") == "2 of 3"
    records.clear()
    assert comparison.learned("mappo") == ""


def test_missing_seeds_are_printed(monkeypatch, capsys):
    cell = Cell("alice_and_bob", "mappo", "mappo", 11, {})
    monkeypatch.setattr(comparison, "cells", lambda: iter([cell]))
    monkeypatch.setattr("sys.argv", ["comparison.py"])
    comparison.main()
    assert capsys.readouterr().out.split() == ["alice_and_bob", "mappo", "10", "of", "11"]
    monkeypatch.setattr("sys.argv", ["comparison.py", "--commands"])
    comparison.main()
    assert capsys.readouterr().out == f"{cell.command(10)}\n"
