"""Folders of runs that begin at the same time."""

import threading

import pytest

from hmasd_jax.cli.train_commands import create_default_folder
from hmasd_jax.config import load
from hmasd_jax.runs import folder
from hmasd_jax.runs.folder import RunError, create, read_config


def test_commands_that_begin_in_one_second_have_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("time.strftime", lambda form: "20260102-030405")
    names = [create_default_folder(load()).name for _ in range(3)]
    first = "alice_and_bob-hmasd-20260102-030405"
    assert names == [first, f"{first}-2", f"{first}-3"]


def test_a_default_folder_that_cannot_be_created_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").touch()
    with pytest.raises(RunError, match="cannot write runs/alice_and_bob-hmasd-"):
        create_default_folder(load())


def test_of_two_processes_that_create_one_folder_the_second_is_refused(tmp_path, monkeypatch):
    """Both find no folder, and then look at their hardware."""
    both, describe = threading.Barrier(2, timeout=60), folder.describe

    def meet(command):
        both.wait()
        return describe(command)

    monkeypatch.setattr(folder, "describe", meet)
    run, refused = tmp_path / "run", []

    def begin(seed):
        try:
            create(run, load(None, {"seed": seed}), [str(seed)])
        except RunError as error:
            refused.append((seed, str(error)))

    threads = [threading.Thread(target=begin, args=(seed,)) for seed in (1, 2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    ((seed, message),) = refused
    assert f"{run} exists: continue it with --resume" in message
    winner = 3 - seed
    assert read_config(run).seed == winner
    assert folder.read_table(run / "run.json")["command"] == [str(winner)]
