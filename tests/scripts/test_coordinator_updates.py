"""The script that records how far updates move a coordinator."""

import json

import pytest

from scripts.coordinator_updates import measure

METRICS = {"success": 0.97512, "coordinator/approx_kl": 0.0123456, "coordinator/skill_entropy": 0.5}


def write_run(run, records):
    """Write the files of a run with one seed."""
    (run / "seed_0").mkdir(parents=True)
    (run / "run.json").write_text(json.dumps({"commit": "abc"}))
    lines = [json.dumps({"seed": 0, "wall_seconds": 1.0, **record}) for record in records]
    (run / "seed_0" / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    return run


def test_records_of_a_solved_task_are_kept(tmp_path):
    run = write_run(
        tmp_path / "run",
        [
            {"kind": "train", "env_steps": 600_000, **METRICS},
            {"kind": "train", "env_steps": 616_000, **METRICS},
            {"kind": "eval", "env_steps": 616_000, "success": 1.0},
            {"kind": "train", "env_steps": 632_000, **METRICS, "success": 1.0},
        ],
    )
    assert measure(run) == {
        "commit": "abc",
        "env_steps": [616_000, 632_000],
        "success": [0.9751, 1.0],
        "coordinator_kl": [0.01235, 0.01235],
        "skill_entropy": [0.5, 0.5],
    }


@pytest.mark.parametrize("name", METRICS)
def test_a_run_without_the_metrics_is_an_error(tmp_path, name):
    record = {"kind": "train", "env_steps": 616_000, **METRICS}
    del record[name]
    with pytest.raises(ValueError, match=r"run has no record of success, coordinator/approx_kl"):
        measure(write_run(tmp_path / "run", [record]))


def test_several_seeds_are_an_error(tmp_path):
    run = write_run(tmp_path / "run", [])
    (run / "seed_1").mkdir()
    with pytest.raises(ValueError, match=r"RUN must hold one seed, but .*run holds 2"):
        measure(run)
