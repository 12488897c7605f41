"""The script that records when seeds first win."""

import json

from hmasd_jax.runs.folder import metrics_path
from scripts.first_wins import measure
from tests.helpers.runs import write_run


def test_a_row_has_the_first_success_and_the_first_tenth(tmp_path):
    """Seed 0 stores a success in its second update and wins a tenth in its fourth; seed 1 never."""
    run = write_run(tmp_path / "run", [[], []])
    (run / "run.json").write_text(json.dumps({"command": ["train", "a"], "commit": "c"}))
    for seed, wins in enumerate([(0.0, 0.02, 0.0, 0.2), (0.0, 0.0)]):
        records = [{"kind": "eval", "env_steps": 0, "success": 1.0}]
        for update, share in enumerate(wins):
            stored = float(share > 0)
            records.append({
                "kind": "train", "env_steps": 10 * update + 10, "success": share,
                "team_reward": 0.0, "exploration/stored_successes": stored,
            })  # fmt: skip
        lines = [
            json.dumps({"seed": seed, "wall_seconds": 0.0, **record}) + "\n" for record in records
        ]
        metrics_path(run, seed).write_text("".join(lines))
    about = {"command": "train a", "commit": "c"}
    assert list(measure(run)) == [
        {**about, "seed": 0, "first success": 20, "a tenth": 40, "trained": 40},
        {**about, "seed": 1, "first success": None, "a tenth": None, "trained": 20},
    ]


def test_a_run_without_successes_or_a_store_has_none(tmp_path):
    run = write_run(tmp_path / "run", [[]])
    (run / "run.json").write_text(json.dumps({"command": ["train"], "commit": "c"}))
    record = {"kind": "train", "env_steps": 10, "team_reward": 0.0, "seed": 0, "wall_seconds": 0.0}
    metrics_path(run, 0).write_text(json.dumps(record) + "\n")
    (row,) = measure(run)
    assert (row["first success"], row["a tenth"], row["trained"]) == (None, None, 10)
