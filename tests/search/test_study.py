"""Searches on disk: created, joined, shared, damaged."""

import json
import threading
from contextlib import ExitStack

import pytest

from hmasd_jax.config import load
from hmasd_jax.runs.folder import RunError, check_unused
from hmasd_jax.search import trials
from hmasd_jax.search.study import (
    Definition,
    create_or_join,
    read_search,
    suggest_values,
    trial_folder,
)

optuna = pytest.importorskip("optuna")

COEF, STEPS = "algorithm.low_entropy_coef", "algorithm.skill_interval"


def definition(settings=((COEF, ["0.001:0.1:log"]), (STEPS, ["25", "50"])), **overrides):
    return Definition(load(None, overrides), [(n, list(t)) for n, t in settings], 2, 1)


def join(folder, number=4, storage=None, name=None, **more):
    return create_or_join(folder, definition(**more), number, storage, name)


def play(search, score=lambda values: 0.5):
    """Take the next trial and complete it; return its number, or None without one."""
    with trials.next_trial(search) as trial:
        if trial is None:
            return None
        values = suggest_values(search, trial)
        trials.complete(search, trial, score(values))
        return trial.number


def states(search):
    return [trial.state.name for trial in search.study.get_trials()]


def test_trial_0_is_the_preset_and_the_others_are_in_the_space(tmp_path):
    search = join(tmp_path / "s")
    assert [play(search) for _ in range(5)] == [0, 1, 2, 3, None]
    first, *others = search.study.get_trials()
    preset = search.definition.config.algorithm
    assert first.params == {COEF: preset.low_entropy_coef, STEPS: str(preset.skill_interval)}
    assert all(0.001 <= trial.params[COEF] <= 0.1 for trial in others)
    assert len({trial.params[COEF] for trial in others}) == 3


def test_a_preset_outside_the_space_is_trial_0_all_the_same(tmp_path):
    search = join(tmp_path / "s", settings=[(STEPS, ["10", "25"])])
    while play(search, lambda values: float(values.get(STEPS, "0") == "25")) is not None:
        pass
    first, *others = search.study.get_trials()
    assert (first.params, first.value) == ({}, 0.0)
    assert all(trial.params[STEPS] in ("10", "25") for trial in others)


def test_a_search_repeats_if_its_trials_come_in_the_same_order(tmp_path):
    values = []
    for name in ("a", "b"):
        search = join(tmp_path / name)
        while play(search, lambda v: v[COEF]) is not None:
            pass
        values.append([trial.params for trial in search.study.get_trials()])
    assert values[0] == values[1]


def test_a_number_of_trials_is_for_all_processes(tmp_path):
    """Two searches open the same storage, as two processes do."""
    one, two = join(tmp_path / "s", 5), join(tmp_path / "s", 5)
    taken = {}

    def work(search):
        numbers = taken.setdefault(id(search), [])
        while (number := play(search)) is not None:
            numbers.append(number)

    threads = [threading.Thread(target=work, args=(search,)) for search in (one, two)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(n for numbers in taken.values() for n in numbers) == [0, 1, 2, 3, 4]
    assert states(read_search(tmp_path / "s")) == ["COMPLETE"] * 5


def test_a_trial_in_training_is_left_alone_and_a_dropped_one_continues(tmp_path):
    search, other = join(tmp_path / "s"), join(tmp_path / "s")
    with trials.next_trial(search) as mine:
        values = suggest_values(search, mine)
        mine.report(0.25, 1)
        run = trial_folder(search.folder, mine.number)
        run.mkdir()
        (run / "run.json").write_text("{}")  # Written before config.json, and then killed.
        with trials.next_trial(other) as theirs:
            assert (mine.number, theirs.number) == (0, 1)
            trials.fail(other, theirs, "no luck")
    # Nobody has told how trial 0 ended: its process was killed.
    assert states(other) == ["RUNNING", "FAIL"]
    with trials.next_trial(other) as again:
        assert again.number == 0
        assert suggest_values(other, again) == values
        assert (run / "run.json").exists()  # Nothing is deleted.
        check_unused(run)  # Yet training can begin there.
        again.report(0.5, 2)
        trials.complete(other, again, 0.5)
    assert read_search(tmp_path / "s").study.trials[0].intermediate_values == {1: 0.25, 2: 0.5}


def test_a_trial_that_ends_before_it_is_locked_is_not_continued(tmp_path, monkeypatch):
    search, other = join(tmp_path / "s"), join(tmp_path / "s")
    hold = trials.hold
    with ExitStack() as mine:
        trial = mine.enter_context(trials.next_trial(search))
        suggest_values(search, trial)

        def end_first(path):
            if states(search) == ["RUNNING"]:
                trials.complete(search, trial, 0.5)
                mine.close()
            return hold(path)

        monkeypatch.setattr(trials, "hold", end_first)
        with trials.next_trial(other) as theirs:
            assert theirs.number == 1


def test_equal_values_are_not_trained_twice(tmp_path):
    search = join(tmp_path / "s", settings=[("algorithm.num_skills", ["2:4"])])
    search.study.enqueue_trial({"algorithm.num_skills": 2})
    search.study.enqueue_trial({"algorithm.num_skills": 2})
    play(search)
    play(search, lambda values: 0.75)
    with trials.next_trial(search) as trial:
        suggest_values(search, trial)
        twin = trials.find_twin(search, trial)
        assert (trial.number, twin.number) == (2, 1)
        trials.repeat(search, trial, twin)
    assert search.study.trials[2].value == 0.75
    assert trials.best(search).number == 1


def test_a_database_can_be_the_storage(tmp_path):
    url = f"sqlite:///{tmp_path}/search.db"
    here = join(tmp_path / "here", storage=url, name="both")
    # A folder of another machine, which does not see the runs of this one.
    there = join(tmp_path / "there", storage=url, name="both")
    with trials.next_trial(here) as mine:
        suggest_values(here, mine)
    with trials.next_trial(there) as theirs:
        assert theirs.number == 1
    assert play(here) == 0
    assert states(read_search(tmp_path / "there")) == ["COMPLETE", "RUNNING"]


def test_a_password_is_not_written_down(tmp_path, monkeypatch):
    folder, create, file = tmp_path / "s", optuna.create_study, f"sqlite:///{tmp_path}/search.db"
    monkeypatch.setattr(
        optuna, "create_study", lambda storage, **more: create(storage=file, **more)
    )
    join(folder, storage="postgresql://me:secret@host/db")
    assert not [path for path in folder.iterdir() if "secret" in path.read_text()]
    with pytest.raises(RunError, match="has a password, which is not kept"):
        read_search(folder)


@pytest.mark.parametrize(
    ("storage", "message"),
    [
        ("nonsense://host/db", "cannot use the storage nonsense://host/db"),
        ("sqlite:////no/such/folder/search.db", "unable to open database file"),
    ],
)
def test_a_storage_that_cannot_be_used_is_one_error(tmp_path, storage, message):
    with pytest.raises(RunError, match=message) as error:
        join(tmp_path / "s", storage=storage)
    assert "\n" not in str(error.value)


def test_only_the_same_search_is_joined(tmp_path):
    folder = tmp_path / "s"
    join(folder)
    for more, message in [
        ({"settings": [(STEPS, ["25", "50"])]}, "vary (was"),
        ({"num_seeds": 3}, "num_seeds (was 5, now 3)"),
        ({"algorithm.num_skills": 3}, "algorithm.num_skills (was"),
    ]:
        with pytest.raises(RunError) as error:
            join(folder, **more)
        assert "is another search" in str(error.value)
        assert message in str(error.value)
    assert join(folder, 9, placement="vmap").trials == 9
    assert join(folder, 9, layout="vmap").trials == 9


def test_a_search_keeps_its_storage(tmp_path):
    folder = tmp_path / "s"
    join(folder)
    with pytest.raises(RunError, match=r"has the storage its journal\.log, not sqlite://"):
        join(folder, storage=f"sqlite:///{tmp_path}/search.db")
    assert not (tmp_path / "search.db").exists()


def test_a_search_keeps_its_name(tmp_path):
    folder = tmp_path / "s"
    join(folder, name="first")
    with pytest.raises(RunError, match="has the name first, not second"):
        join(folder, name="second")
    assert join(folder).study.study_name == "first"


def test_a_search_goes_on_when_the_library_has_gained_a_setting(tmp_path):
    folder = tmp_path / "s"
    table = definition().to_json()
    del table["config"]["algorithm"]["solved"]["balance"]
    join(folder).study.set_user_attr("definition", table)
    assert join(folder).trials == 4


def test_a_search_that_could_not_begin_can_begin_later(tmp_path):
    folder = tmp_path / "s"
    with pytest.raises(RunError):
        join(folder, storage="sqlite:////no/such/folder/search.db")
    assert play(join(folder, storage=f"sqlite:///{tmp_path}/search.db")) == 0


def test_a_search_whose_process_died_while_it_began_begins_again(tmp_path):
    folder = tmp_path / "s"
    join(folder)
    (folder / "study.json").unlink()  # It is written last.
    assert [play(join(folder)) for _ in range(2)] == [0, 1]


def test_a_folder_in_use_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(RunError, match="is not empty, and not a search"):
        join(tmp_path)
    with pytest.raises(RunError, match=r"is not a search: it has no study\.json"):
        read_search(tmp_path)


def test_half_a_line_at_the_end_of_the_journal_is_moved_away(tmp_path):
    folder = tmp_path / "s"
    play(join(folder))
    journal = folder / "journal.log"
    with journal.open("a") as file:
        file.write('{"op_code":4,"wor')
    assert [play(join(folder)) for _ in range(2)] == [1, 2]
    assert states(read_search(folder)) == ["COMPLETE"] * 3
    assert (folder / "journal.removed.log").read_text() == '{"op_code":4,"wor\n'


def test_a_damaged_journal_is_one_error_and_stays(tmp_path):
    folder = tmp_path / "s"
    play(join(folder))
    journal = folder / "journal.log"
    lines = journal.read_text().splitlines()
    damaged = "\n".join([lines[0], "{damaged", *lines[1:]]) + "\n"
    journal.write_text(damaged)
    for use in (join, read_search):
        with pytest.raises(RunError, match=r"cannot use the storage .*journal\.log"):
            use(folder)
    assert journal.read_text() == damaged
    journal.unlink()
    with pytest.raises(RunError, match=r"it has no journal\.log"):
        read_search(folder)
    assert not journal.exists()


def test_reading_writes_nothing(tmp_path):
    folder = tmp_path / "s"
    play(join(folder))
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    read_search(folder)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    assert json.loads((folder / "preset.json").read_text())["num_seeds"] == 5
