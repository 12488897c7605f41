"""The table at the end of a run."""

import io

import pytest
from rich.console import Console

from hmasd_jax.cli import summary
from tests.helpers.runs import write_run


def show(run):
    console = Console(file=io.StringIO(), width=160)
    console.print(summary.table(run))
    return console.file.getvalue()


def test_the_mean_of_the_last_evaluations_leaves_out_step_0(tmp_path):
    run = write_run(tmp_path / "run", [[0.0, 0.5, 1.0], [0.0, 1.0, 0.6]])
    assert summary.summarize(run, 0)["last_evaluations"] == pytest.approx(0.75)
    text = show(run)
    assert "last 2 evaluations" in text
    assert "0.775 ± 0.025" in text


def test_a_run_that_has_only_begun_is_summarized_by_step_0(tmp_path):
    run = write_run(tmp_path / "run", [[0.25]])
    assert summary.summarize(run, 0)["last_evaluations"] == 0.25
    assert "last evaluation " in show(run)


@pytest.mark.parametrize(("seeds", "warns"), [(2, True), (5, False)])
def test_few_seeds_come_with_a_warning(tmp_path, seeds, warns):
    text = show(write_run(tmp_path / "run", [[0.0, 1.0]] * seeds))
    assert (f"Statistics over {seeds} seeds say little" in text) == warns
