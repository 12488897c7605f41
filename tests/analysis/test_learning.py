"""Bands and statistics of the learning of a run."""

import numpy as np
import pytest

from hmasd_jax.analysis import learning
from hmasd_jax.cli import summary as cli_summary
from hmasd_jax.runs import metrics_log
from hmasd_jax.runs.folder import metrics_path
from hmasd_jax.search import score as search_score
from tests.helpers.runs import STEPS, write_run


@pytest.fixture
def run(tmp_path):
    return write_run(tmp_path / "run", [[0, 0.5, 1, 1], [0, 0, 0.5, 1], [0, 0, 0]])


def test_bands_are_over_the_steps_that_all_seeds_have(run):
    band = learning.bands(learning.read_records(run), "eval")["success"]
    np.testing.assert_array_equal(band.env_steps, STEPS[:3])
    np.testing.assert_array_equal(band.values, [[0, 0.5, 1], [0, 0, 0.5], [0, 0, 0]])
    np.testing.assert_allclose(band.mean, [0, 0.5 / 3, 0.5])
    assert band.low[0] == band.high[0] == 0
    assert band.low[2] < 0.5 < band.high[2]
    np.testing.assert_array_equal(band.seconds, 1.0)
    assert set(learning.bands(learning.read_records(run), "train")) == {
        "coordinator/team_entropy", "discriminators/team_accuracy"
    }  # fmt: skip


def test_scores_leave_out_the_untrained_policy(run):
    records = learning.read_records(run)
    learned = learning.summarize(records, "success", 0.9)
    assert learned.seeds == 3
    assert learned.last == 3
    assert learned.mean.value == pytest.approx(np.mean([2.5 / 3, 0.5, 0.0]))
    assert learned.solved.value == 0
    learned = learning.summarize(records, "success", 0.9, last=1)
    assert learned.mean.value == pytest.approx(np.mean([1.0, 1.0, 0.0]))
    assert learned.solved.value == pytest.approx(2 / 3)
    assert learned.reached == [(200, 1.0), (300, 1.0)]
    assert learning.main_metric(learning.bands(records, "eval")) == "success"
    assert learning.main_metric(["return", "length"]) == "return"


def test_a_run_has_the_same_scores_everywhere(run):
    """A seed that has fewer evaluations than others counts with those it has."""
    learned = learning.summarize(learning.read_records(run), "success", 0.9)
    summary = cli_summary.over_seeds({str(i): cli_summary.summarize(run, i) for i in range(3)})
    score = list(search_score.scores_so_far([[0.5, 1, 1], [0, 0.5, 1], [0, 0, 0]], 3, 3, 5))[-1][1]
    assert learned.mean.value == pytest.approx(summary["last_evaluations_mean"])
    assert learned.mean.value == pytest.approx(score)


def test_before_the_first_evaluation_there_is_nothing_to_say(tmp_path):
    records = learning.read_records(write_run(tmp_path / "new", [[0.5]]))
    assert learning.summarize(records, "success", 0.9) is None


def test_rows_of_curves_are_tidy(run):
    rows = learning.curve_rows(learning.read_records(run))
    found = [
        r["value"] for r in rows if (r["seed"], r["kind"], r["metric"]) == (1, "eval", "success")
    ]
    assert found == [0, 0, 0.5, 1]
    assert set(rows[0]) == {"seed", "kind", "env_steps", "wall_seconds", "metric", "value"}


def test_damaged_lines_are_left_out_and_told(run):
    path = metrics_path(run, 1)
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([*lines[:2], "{\x00\n", *lines[3:]]))
    assert len(learning.read_records(run)[1]) == 7
    assert metrics_log.find_damage(path) == f"1 line of {path} is no record of metrics"
    assert metrics_log.find_damage(metrics_path(run, 0)) is None
