"""The table at the end of a run."""

import io
import json

import pytest
from rich.console import Console

from hmasd_jax.cli import summary
from hmasd_jax.training.job import Event
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


def test_seeds_that_a_command_does_not_train_keep_their_ends(tmp_path):
    run = write_run(tmp_path / "run", [[0.0, 0.5], [0.0, 1.0]])
    summary.write(run, {0: Event("finished", 0, {}), 7: Event("failed", 7, {"message": "full"})})
    summary.write(run, {1: Event("finished", 1, {})})
    seeds = json.loads((run / "summary.json").read_text())["seeds"]
    assert [seeds[name]["status"] for name in "01"] == ["finished", "finished"]
    assert seeds["7"] == {"status": "failed", "message": "full"}
    assert seeds["1"]["final"] == 1.0


def test_a_seed_that_has_finished_has_no_message_of_an_earlier_failure(tmp_path):
    run = write_run(tmp_path / "run", [[0.0, 0.5]])
    summary.write(run, {0: Event("failed", 0, {"message": "full"})})
    summary.write(run, {0: Event("finished", 0, {})})
    seed = json.loads((run / "summary.json").read_text())["seeds"]["0"]
    assert seed["status"] == "finished"
    assert "message" not in seed


def test_a_damaged_summary_is_written_anew(tmp_path):
    run = write_run(tmp_path / "run", [[0.0, 0.5]])
    for text in ("[]", "{", '{"seeds": 3}', '{"seeds": {"0": 3}}'):
        (run / "summary.json").write_text(text)
        summary.write(run, {})
        assert json.loads((run / "summary.json").read_text())["seeds"]["0"]["final"] == 0.5


def test_a_run_that_has_only_begun_is_summarized_by_step_0(tmp_path):
    run = write_run(tmp_path / "run", [[0.25]])
    assert summary.summarize(run, 0)["last_evaluations"] == 0.25
    assert "last evaluation " in show(run)


@pytest.mark.parametrize(("seeds", "warns"), [(2, True), (5, False)])
def test_few_seeds_come_with_a_warning(tmp_path, seeds, warns):
    text = show(write_run(tmp_path / "run", [[0.0, 1.0]] * seeds))
    assert (f"Statistics over {seeds} seeds say little" in text) == warns
