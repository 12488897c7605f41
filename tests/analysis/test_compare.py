"""`compare`: scores at the same env steps, known statistics, and one task only."""

import json

import numpy as np
import pytest

from hmasd_jax.analysis.compare import compare_runs
from hmasd_jax.cli.main import main
from hmasd_jax.runs.folder import RunError, metrics_path
from tests.helpers.runs import write_run


@pytest.fixture
def runs(tmp_path):
    good = write_run(tmp_path / "good", [[0.0, 0.5, 1.0, 1.0], [0.0, 0.5, 0.75]])
    bad = write_run(tmp_path / "bad", [[0.0, 0.0, 0.5, 0.9], [0.0, 0.25, 0.25, 0.9]])
    return [good, bad]


def test_scores_are_taken_where_all_seeds_were_evaluated(runs):
    comparison = compare_runs(runs, last=2)
    assert comparison.env_steps == 200  # the second seed of `good` was evaluated no further
    np.testing.assert_allclose(comparison.scores, [[0.75, 0.625], [0.25, 0.25]])
    assert comparison.labels == ["good (2 seeds)", "bad (2 seeds)"]


def test_prints_statistics_and_draws(runs, tmp_path, capsys):
    out = tmp_path / "plots" / "comparison.png"
    words = ["compare", *map(str, runs), "--out", str(out), "--last", "1", "--solved-at", "0.7"]
    assert main(words) == 0
    output = capsys.readouterr()
    text = output.out
    assert "Statistics over 2 seeds say little" in text
    assert f"next: python -m hmasd_jax.train report {runs[0]} {runs[1]}" in output.err
    # At 200: 1 and 0.75 against 0.5 and 0.25. Every seed of the first is better than any of the
    # second, in whatever bootstrap sample; two of two seeds are above 0.7, and none.
    assert "0.875 [0.750, 1.000]" in text
    assert "0.375 [0.250, 0.500]" in text
    assert "1.000 [0.342, 1.000]" in text
    assert "0.000 [0.000, 0.658]" in text
    assert "1.000 [1.000, 1.000]" in text
    assert text.splitlines()[-1] == str(out)
    assert out.read_bytes().startswith(b"\x89PNG")


def test_one_run_alone_has_no_pairs(runs, tmp_path, capsys):
    assert main(["compare", str(runs[1]), "--out", str(tmp_path / "x.png")]) == 2
    assert "have 3 evaluations of success after step 0 in common" in capsys.readouterr().err
    assert main(["compare", str(runs[1]), "--last", "3", "--out", str(tmp_path / "x.png")]) == 0
    assert "Probability" not in capsys.readouterr().out


def test_tasks_without_a_success_are_judged_by_the_return(tmp_path, capsys):
    runs = [
        write_run(tmp_path / name, [[0.0, 0.0, 20.0]], metric="return") for name in ("one", "two")
    ]
    words = [str(runs[0]), str(runs[1]), "--out", str(tmp_path / "x.png")]
    assert main(["compare", *words, "--last", "1"]) == 0
    text = capsys.readouterr().out
    assert "return of the last 1 evaluations" in text
    assert "seeds > 0" in text
    assert "20.000 [20.000, 20.000]" in text
    assert main(["plot", *words]) == 0
    assert (tmp_path / "x.csv").read_text().startswith("label,seed,env_steps,return")
    assert main(["compare", *words, "--last", "1", "--solved-at", "30"]) == 0
    assert "seeds ≥ 30" in capsys.readouterr().out


def test_a_metric_that_is_not_there_is_told_with_those_that_are(runs, tmp_path, capsys):
    other = write_run(tmp_path / "other", [[0.0, 20.0]], metric="return")
    assert main(["plot", str(runs[0]), str(other), "--out", str(tmp_path / "x.png")]) == 2
    assert capsys.readouterr().err == (
        f"error: {runs[0]} has no evaluation of return yet: there are length, success; choose one "
        "by --metric\n"
    )


def test_refuses_what_cannot_be_compared(runs, tmp_path):
    other = write_run(tmp_path / "other", [[0.0]], **{"env.max_steps": 50})
    with pytest.raises(
        RunError, match=r"other is on another task than .*good: max_steps is 50, not"
    ):
        compare_runs([runs[0], other])
    with pytest.raises(RunError, match="no evaluation of reward yet: there are length, success"):
        compare_runs(runs, metric="reward")
    with pytest.raises(RunError, match="is not a run folder"):
        compare_runs([tmp_path])


def test_another_view_of_the_same_task_is_compared(runs, tmp_path):
    other = write_run(tmp_path / "other", [[0.0, 0.5]], **{"env.observation": "one_hot"})
    assert compare_runs([runs[0], other], last=1).env_steps == 100


def test_a_label_counts_the_seeds_that_are_shown(runs):
    metrics_path(runs[1], 1).write_text("")
    assert compare_runs(runs, last=1).labels == ["good (2 seeds)", "bad (1 seed)"]


def test_only_runs_on_one_task_are_suggested_for_comparison(runs, tmp_path, capsys):
    other = write_run(tmp_path / "other", [[0.0]], **{"env.max_steps": 50})
    for second, command in [(runs[1], "compare"), (other, "report")]:
        words = [str(runs[0]), str(second)]
        assert main(["plot", *words, "--out", str(tmp_path / "x.png")]) == 0
        next_line = capsys.readouterr().err.splitlines()[-1]
        assert next_line == f"next: python -m hmasd_jax.train {command} {' '.join(words)}"


def test_runs_that_were_evaluated_at_other_steps_are_told_by_their_steps(runs, tmp_path):
    other = write_run(tmp_path / "other", [[0.0, 0.5, 1.0]])
    path = metrics_path(other, 0)
    records = [json.loads(line) for line in path.read_text().splitlines()]
    shifted = [r | {"env_steps": r["env_steps"] + 7 * (r["env_steps"] > 0)} for r in records]
    path.write_text("".join(json.dumps(record) + "\n" for record in shifted))
    with pytest.raises(RunError, match=r"0 evaluations .* they begin at \[100, 107\]; train with"):
        compare_runs([runs[0], other])
