"""Records name the command, the run and the rows, and agree with the scripts that made them."""

import json
import re

import pytest

from hmasd_jax.config import load, to_json
from hmasd_jax.runs.folder import write_json
from scripts import (
    battle_tactics,
    random_play,
    record_result,
    record_tried,
    records,
    run_records,
    tactics,
)
from scripts.paper import TASKS, final_scores, summarize_record
from scripts.result_settings import changed_settings, pays_otherwise
from tests.helpers.runs import STEPS, write_run


@pytest.fixture
def run(tmp_path):
    """A finished run folder of two seeds."""
    folder = write_run(tmp_path / "run", [[0.0, 0.5, 0.5, 1.0], [0.0, 0.0, 0.25, 0.5]])
    (folder / "run.json").write_text(json.dumps({"command": ["python", "x"], "commit": "abc"}))
    return folder


def test_records_name_the_script_from_the_root(run, monkeypatch):
    monkeypatch.setattr("sys.argv", [str(records.ROOT / "scripts" / "x.py"), "RUN", "OUT"])
    about = records.describe_script(run)
    assert about["command"] == ["python", "scripts/x.py", "RUN", "OUT"]
    assert about["run"]["commit"] == "abc"
    assert "run" not in records.describe_script()


def test_rows_follow_what_produced_them(tmp_path):
    out = tmp_path / "new" / "rows.json"
    records.write_rows(out, {"commit": "abc"}, [{"wins": 0.5}])
    assert json.loads(out.read_text()) == {"commit": "abc", "rows": [{"wins": 0.5}]}


def test_tactics_that_are_recorded_are_those_that_are_played():
    kept = json.loads((records.RESULTS / "micro_battle" / "tactics.json").read_text())
    names = ("scenario", "balance", "tactic", "random_actions")
    recorded = [tuple(row[name] for name in names) for row in kept["rows"]]
    assert recorded == [battle[: len(names)] for battle in battle_tactics.BATTLES]
    assert {battle.tactic for battle in battle_tactics.BATTLES} == set(tactics.TACTICS)


def test_tasks_of_random_play_are_recorded_in_full():
    rows = json.loads((records.RESULTS / "random_play.json").read_text())
    assert {name: row["episodes"] for name, row in rows.items()} == {
        name: task.episodes for name, task in random_play.TASKS.items()
    }


def test_random_play_of_alice_and_bob(monkeypatch):
    monkeypatch.setattr(random_play, "COPIES", 4)
    row = random_play.measure(random_play.Task(8, "alice_and_bob", {"max_steps": 7}))
    assert row["episodes"] == row["out_of_time"] + row["paid_episodes"] == 8
    assert row["mean_return"] == row["paid_episodes"] / 8
    assert 7 * row["out_of_time"] <= row["env_steps"] <= 7 * 8


def test_record_of_a_run(run):
    kept = run_records.record(run)
    assert kept["command"] == "python x"
    assert (kept["metric"], kept["env_steps"]) == ("success", STEPS)
    assert kept["values"] == [[0.0, 0.5, 0.5, 1.0], [0.0, 0.0, 0.25, 0.5]]
    # Four training records over ten parts: a part without any has no mean.
    accuracy = kept["training_means"][0]["discriminators/team_accuracy"]
    assert [x for x in accuracy if x is not None] == [0.0, 0.5, 0.5, 1.0]
    assert len(accuracy) == 10


def test_an_unfinished_run_is_not_recorded(tmp_path, run):
    with pytest.raises(ValueError, match="must be the folder of a run"):
        run_records.record(tmp_path)
    shorten(run / "seed_1")
    with pytest.raises(ValueError, match=r"seed 1 .* --resume"):
        run_records.record(run)
    (run / "seed_0" / "metrics.jsonl").write_text("")
    with pytest.raises(ValueError, match=r"seed 0 .* no evaluation.* --resume"):
        run_records.record(run)


def shorten(seed):
    """Remove the last evaluation and the training behind it from the folder of a seed."""
    metrics = seed / "metrics.jsonl"
    metrics.write_text("".join(metrics.read_text().splitlines(keepends=True)[:-2]))


def test_results_go_to_the_folder_of_a_task(tmp_path, run):
    with pytest.raises(ValueError, match="one of alice_and_bob, "):
        record_result.keep([run], tmp_path / "hmasd.json")


@pytest.fixture
def seed_runs(tmp_path):
    """Two runs of one seed each, from the same command."""
    runs = []
    for seed, values in enumerate([[0.0, 0.5, 0.5, 1.0], [0.0, 0.0, 0.25, 0.5]]):
        runs.append(write_run(tmp_path / f"run_{seed}", [values]))
        (runs[-1] / "seed_0").rename(runs[-1] / f"seed_{seed}")
        command = f"python x --seed-index {seed} --seed 3 --total-env-steps {seed}".split()
        (runs[-1] / "config.json").write_text(json.dumps({"total_env_steps": 8}))
        (runs[-1] / "run.json").write_text(json.dumps({"command": command, "commit": "abc"}))
    return runs


def test_runs_of_single_seeds_are_recorded_as_one(seed_runs, run):
    kept = run_records.record_together(seed_runs)
    assert kept["command"] == ("python x --seed 3 --total-env-steps 8 --seed-index I for I = 0,1")
    assert kept["values"] == [[0.0, 0.5, 0.5, 1.0], [0.0, 0.0, 0.25, 0.5]]
    assert (len(kept["training_means"]), len(kept["wall_seconds"])) == (2, 2)
    assert run_records.record_together([run]) == run_records.record(run)


@pytest.mark.parametrize("changed", [{"command": ["python", "y"]}, {"commit": "def"}])
def test_runs_of_different_commands_or_commits_are_not_recorded_as_one(seed_runs, changed):
    about = json.loads((seed_runs[1] / "run.json").read_text())
    (seed_runs[1] / "run.json").write_text(json.dumps(about | changed))
    with pytest.raises(ValueError, match="run_1 must have the command and the commit of"):
        run_records.record_together(seed_runs)


def test_runs_that_ended_at_different_steps_are_not_recorded_as_one(seed_runs):
    shorten(seed_runs[1] / "seed_1")
    with pytest.raises(ValueError, match="run_1 was not evaluated at the steps of the others"):
        run_records.record_together(seed_runs)


@pytest.fixture
def stopped_run(tmp_path):
    """A run folder of two seeds, of which the second was stopped without reward."""
    folder = write_run(tmp_path / "run", [[0.0, 0.0, 0.5, 1.0], [0.0, 0.0, 0.0]])
    (folder / "run.json").write_text(json.dumps({"command": ["python", "x"], "commit": "abc"}))
    (folder / "config.json").write_text(
        json.dumps({"total_env_steps": STEPS[-1], "eval_interval": STEPS[1]})
    )
    return folder


def test_a_seed_that_was_stopped_without_reward_is_recorded(stopped_run):
    kept = run_records.record(stopped_run)
    assert kept["env_steps"] == STEPS
    assert kept["values"] == [[0.0, 0.0, 0.5, 1.0], [0.0, 0.0, 0.0]]
    assert run_records.stopped(kept) == ", 1 stopped"
    shorten(stopped_run / "seed_1")
    with pytest.raises(ValueError, match=r"seed 1 .* was not evaluated at the steps of the others"):
        run_records.record(stopped_run)


def test_only_seeds_without_reward_count_as_stopped(stopped_run):
    kept = run_records.record(stopped_run)
    assert run_records.cut_seeds(kept) == []
    rewarded = kept | {"values": [[0.0] * 4, [0.5, 0.0]]}
    assert (run_records.stopped(rewarded), run_records.cut_seeds(rewarded)) == ("", [1])


def test_reward_in_training_alone_counts(stopped_run):
    kept = run_records.record(stopped_run)
    kept["training_means"][1] = {"team_reward": [0.0, 0.001]}
    assert (run_records.stopped(kept), run_records.cut_seeds(kept)) == ("", [1])


def test_a_seed_that_was_stopped_with_reward_is_not_recorded(stopped_run):
    with (stopped_run / "seed_1" / "metrics.jsonl").open("a") as metrics:
        entry = {"kind": "train", "seed": 1, "env_steps": 200, "wall_seconds": 1.0}
        metrics.write(json.dumps(entry | {"team_reward": 0.001}) + "\n")
    with pytest.raises(ValueError, match=r"seed 1 .* was not evaluated at the steps of the others"):
        run_records.record(stopped_run)


def test_a_stopped_seed_scores_what_it_had():
    steps = [*range(7)]
    record = {"metric": "success", "env_steps": steps, "values": [[0.0, *[1.0] * 6], [0.0] * 6]}
    assert final_scores(record).tolist() == [100.0, 0.0]


def test_the_untrained_policy_has_no_part_in_a_score():
    record = {"metric": "return", "env_steps": [*range(6)], "values": [[90.0, *[3.0] * 5]]}
    assert final_scores(record).tolist() == [3.0]
    with pytest.raises(ValueError, match="cannot take the last 5 of 4"):
        final_scores({"metric": "return", "env_steps": [*range(5)], "values": [[9.0] * 5]})


def test_a_run_with_too_few_evaluations_is_refused_before_anything_is_written(run, monkeypatch):
    write_json(run / "config.json", to_json(load(None)))
    monkeypatch.setattr(record_result, "RESULTS", run.parent)
    with pytest.raises(ValueError, match="cannot take the last 5 of 3"):
        record_result.keep([run], run.parent / "alice_and_bob" / "x.json")
    assert not (run.parent / "alice_and_bob").exists()


@pytest.mark.parametrize(
    "words",
    [
        ["--seed-index", "3", "--run-dir", "a run"],
        ["--seed_index=3", "--run-dir=a run"],
        ["--run_dir", "a run", "--seed_index", "3"],
    ],
)
def test_an_option_may_be_typed_in_any_form(words):
    command = run_records.plain_command(["python", "x", *words, "--env.options", "walls=true"])
    assert run_records.recorded_seeds({"command": command, "values": [[0.0]]}) == [3]
    assert run_records.any_seed(command) == "python x --env.options walls=true"


def test_a_run_without_a_preset_is_one_of_the_preset_that_commands_begin_with():
    record = {"command": "python -m hmasd_jax.train seed_sweep", "config": to_json(load(None))}
    assert changed_settings(record) == {}


def test_seeds_are_added_to_a_record_with_their_commit(seed_runs):
    first = run_records.record_together(seed_runs[:1])
    about = json.loads((seed_runs[1] / "run.json").read_text())
    (seed_runs[1] / "run.json").write_text(json.dumps(about | {"commit": "def", "cpu": "new"}))
    both = run_records.add_seeds(first, seed_runs[1:])
    assert both["command"] == "python x --seed 3 --total-env-steps 8 --seed-index I for I = 0,1"
    assert both["commits"] == ["abc", "def"]
    assert both["cpus"] == [None, "new"]
    assert both["values"] == [[0.0, 0.5, 0.5, 1.0], [0.0, 0.0, 0.25, 0.5]]
    assert (len(both["training_means"]), len(both["wall_seconds"])) == (2, 2)
    with pytest.raises(ValueError, match="seed 1 is in the record already"):
        run_records.add_seeds(both, seed_runs[1:])
    with pytest.raises(ValueError, match="was not evaluated at the steps of the others"):
        run_records.add_seeds(first | {"env_steps": [0]}, seed_runs[1:])
    with pytest.raises(ValueError, match="run_1 must have the command of the record"):
        run_records.add_seeds(first | {"command": "python y"}, seed_runs[1:])


def test_a_record_names_the_commits_at_which_its_seeds_were_resumed(seed_runs):
    about = json.loads((seed_runs[1] / "run.json").read_text())
    resumed = [{"commit": commit, "command": ["python"]} for commit in ("abc", "def", "def")]
    (seed_runs[1] / "run.json").write_text(json.dumps(about | {"resumed": resumed}))
    kept = run_records.record_together(seed_runs)
    assert "resumed" not in kept
    assert kept["later_commits"] == [[], ["def"]]
    assert run_records.commits_of(kept) == ["abc", "def"]
    earlier = run_records.record_together(seed_runs[:1])
    del earlier["later_commits"]
    both = run_records.add_seeds(earlier, seed_runs[1:])
    assert both["later_commits"] == [[], ["def"]]


def test_a_sweep_and_single_seeds_train_the_same():
    record = {"command": "train seed_sweep --num-seeds 2 --run-dir x", "values": [[0.0], [1.0]]}
    assert run_records.recorded_seeds(record) == [0, 1]
    single = "train train --num-seeds 30 --seed-index 4 --run-dir y"
    assert run_records.any_count(single) == run_records.any_count(record["command"])


def test_commands_of_several_seeds_are_a_loop_of_a_shell():
    command = "python -m hmasd_jax.train train --config x --seed-index I for I = 0,1"
    loop = "for I in 0 1; do python -m hmasd_jax.train train --config x --seed-index $I; done"
    assert record_result.shell(command) == loop
    assert record_result.shell("python x") == "python x"


def test_page_shows_what_was_recorded():
    assert record_result.PAGE.read_text() == record_result.page()
    assert record_result.README.read_text() == record_result.readme()


def test_numbers_of_the_readme_are_those_of_the_records_that_they_link_to():
    """A number is marked * where its record has other settings than today's preset.

    It is marked † where the exploration bonus has changed since.
    """
    found = re.findall(
        r"\[\**([\d.]+) ± ([\d.]+)\**\]\((results/([\w/]+)/\w+\.json)\)"
        r"(?:, ([\d.]+))? at [^|]*?( †)?( \*)? \|",
        record_result.README.read_text(),
    )
    assert len(found) == 21
    for mean, std, path, task, worst, dagger, star in found:
        record = json.loads((records.ROOT / path).read_text())
        final = summarize_record(record, TASKS[task])
        assert (mean, std) == (f"{final['mean']:.1f}", f"{final['std']:.1f}"), path
        assert worst in ("", f"{final['min']:.1f}"), path
        assert bool(star) == bool(changed_settings(record)), path
        assert bool(dagger) == pays_otherwise(record), path


def test_a_text_without_the_place_is_refused():
    assert records.fill_place("a <!-- x --> b <!-- end --> c", "x", "y") == (
        "a <!-- x -->\ny\n<!-- end --> c"
    )
    with pytest.raises(ValueError, match="no place for y"):
        records.fill_place("<!-- x --> <!-- end -->", "y", "z")


def test_tried_runs_are_added_and_replaced(run, tmp_path):
    out = tmp_path / "new" / "tried.json"
    record_tried.add(out, [run], "nothing")
    other = write_run(tmp_path / "other", [[0.0, 1.0]])
    (other / "run.json").write_text(json.dumps({"command": ["python", "y"]}))
    record_tried.add(out, [other], "all")
    entries = record_tried.add(out, [run], "nothing at all")
    assert json.loads(out.read_text()) == entries
    assert [entry["changed"] for entry in entries] == ["all", "nothing at all"]
    assert entries[0]["values"] == [[0.0, 1.0]]


def test_equal_commands_of_two_runs_are_two_tried_entries(run, tmp_path):
    twin = write_run(tmp_path / "twin", [[0.0, 1.0]])
    about = json.loads((run / "run.json").read_text())
    (twin / "run.json").write_text(json.dumps(about | {"started": "later"}))
    record_tried.add(tmp_path / "tried.json", [run], "nothing")
    assert len(record_tried.add(tmp_path / "tried.json", [twin, twin], "nothing")) == 2


def test_seeds_that_were_trained_one_by_one_in_a_folder_are_named(seed_runs):
    first, second = seed_runs
    (first / "seed_0").rename(first / "seed_2")
    (second / "seed_1").rename(first / "seed_3")
    recorded = run_records.record(first)
    assert run_records.recorded_seeds(recorded) == [2, 3]
    assert recorded["command"] == "python x --seed 3 --total-env-steps 8 --seed-index I for I = 2,3"


def test_seeds_on_a_gpu_share_their_time():
    cpu = {"device": "cpu: cpu", "wall_seconds": [60.0, 120.0], "values": [[], []]}
    assert record_result.minutes(cpu) == "3"
    gpu = {"device": "gpu: NVIDIA H100", "wall_seconds": [119.0, 120.0], "values": [[], []]}
    assert record_result.minutes(gpu) == "2 (GPU)"
    both = gpu | {"devices": ["gpu: NVIDIA H100", "cpu: cpu"]}
    assert record_result.minutes(both) == "2 + 2 (GPU)"
