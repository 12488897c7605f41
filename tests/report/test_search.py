"""The folder of a search in a report: Optuna's plots, all trials, the preset and the best one."""

import json

import pytest

from hmasd_jax.cli.main import main
from hmasd_jax.config import load, to_json
from hmasd_jax.report import search_views
from hmasd_jax.report.serve import LiveReport
from hmasd_jax.runs.folder import RunError
from hmasd_jax.search import trials
from hmasd_jax.search.space import change
from hmasd_jax.search.study import (
    Definition,
    create_or_join,
    read_search,
    suggest_values,
    trial_folder,
)
from tests.helpers.runs import write_run
from tests.report.test_page import MAPPO, body_of, fingerprint

optuna = pytest.importorskip("optuna")

RATE = "algorithm.ppo.learning_rate"


def play(search, score):
    """Complete a trial with constant evaluations, without training."""
    with trials.next_trial(search) as trial:
        values = suggest_values(search, trial)
        run = trial_folder(search.folder, trial.number)
        write_run(run, [[0.0, score, score]])
        config = change(search.definition.config, values)
        (run / "config.json").write_text(json.dumps(to_json(config)))
        trials.complete(search, trial, score)


@pytest.fixture
def search(tmp_path):
    """A search of six trials, of which trial 3 is the best and trial 5 has failed."""
    settings = [(RATE, ["1e-5:1e-2:log"]), ("algorithm.ppo.clip_epsilon", ["0.1", "0.2"])]
    definition = Definition(load(None, MAPPO | {"num_seeds": 1}), settings, 2, 5)
    search = create_or_join(tmp_path / "found", definition, 6, None, None)
    for score in (0.25, 0.5, 0.125, 0.75, 0.375):
        play(search, score)
    with trials.next_trial(search) as trial:
        suggest_values(search, trial)
        trials.fail(search, trial, "seed 0: <bad> luck")
    return search


def test_a_search_stands_for_its_preset_and_its_best_trial(search, tmp_path):
    out, before = tmp_path / "report.html", fingerprint(search.folder)
    assert main(["report", str(search.folder), "--out", str(out), "--episodes", "2"]) == 0
    assert fingerprint(search.folder) == before
    text = body_of(out)
    assert "<h2>Search found</h2>" in text
    assert "6 trials: 5 complete, 1 failed" in text
    assert "The score of a trial is its success, mean of the last 2 evaluations of one seed" in text
    assert "failed: seed 0: &lt;bad&gt; luck" in text
    for name in ("trial_0 (1 seed)", "trial_3 (1 seed)"):
        assert f"<tr><th>{name}</th>" in text
    assert "trial_1" not in text
    assert 'id="search0-history"' in text
    assert 'id="search0-importances"' in text


def test_trials_are_listed_from_the_best_to_the_failed(search):
    view = search_views.view_search(search, "s")
    assert [number for number, *_ in view.rows] == ["3", "1", "4", "0 (preset)", "2", "5"]
    assert view.rows[3][1:] == ("complete", "0.250", ["0.0005", "0.2"])


def test_the_plots_show_the_scores_and_how_much_each_setting_matters(search):
    study = search_views.complete_trials(search)
    history = search_views.draw_history(study, "success")
    assert [list(trace.y) for trace in history.data] == [
        [0.25, 0.5, 0.125, 0.75, 0.375],
        [0.25, 0.5, 0.5, 0.75, 0.75],
    ]
    bars = search_views.draw_importances(study).data[0]
    assert set(bars.y) == {RATE, "algorithm.ppo.clip_epsilon"}
    assert sum(bars.x) == pytest.approx(1)


def test_importances_need_trials_that_differ(search):
    study = search_views.complete_trials(search)
    few = optuna.create_study(direction="maximize")
    few.add_trials(study.trials[:2])
    assert search_views.draw_importances(few) is None
    equal = optuna.create_study(direction="maximize")
    for trial in study.trials:
        trial.value = 0.5
        equal.add_trial(trial)
    assert search_views.draw_importances(equal) is None


def test_other_runs_stay_as_they_are(search, tmp_path):
    other = write_run(tmp_path / "other", [[0.0]])
    runs = [other, search.folder, trial_folder(search.folder, 0)]
    found = [other, *(trial_folder(search.folder, number) for number in (0, 3))]
    assert search_views.expand(runs) == found
    assert len(search_views.view_searches(runs)) == 1


def test_a_search_without_a_trial_is_one_error(tmp_path, search):
    empty = create_or_join(tmp_path / "empty", search.definition, 3, None, None)
    with pytest.raises(RunError, match="has no trial to show yet"):
        search_views.expand([empty.folder])


def test_a_live_page_follows_the_search(search):
    live = LiveReport([search.folder], lambda version: f"<p>{version}</p>")
    assert live.look()
    assert not live.look()
    create_or_join(search.folder, search.definition, 7, None, None)
    play(read_search(search.folder), 0.875)
    assert live.look()
    assert search_views.expand([search.folder])[-1].name == "trial_6"
