"""Order of the writes, which decides what a power cut leaves."""

import errno
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hmasd_jax.runs import checkpoint, metrics_log
from hmasd_jax.runs.durable import replace, sync_folder
from hmasd_jax.runs.folder import metrics_path, write_json
from hmasd_jax.training.seed_run import SeedRun

LINE = '{"kind": "train", "seed": 0, "env_steps": %d, "wall_seconds": 1.0}\n'


@pytest.fixture
def synced(monkeypatch):
    """Paths in the order in which they reach the disk, each with its content."""
    found, fsync = [], os.fsync

    def note(descriptor):
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        content = sorted(x.name for x in path.iterdir()) if path.is_dir() else path.read_bytes()
        found.append((path.name, content))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", note)
    return found


@pytest.fixture
def seed(tmp_path, monkeypatch):
    """Seed 0 of a run whose configuration is empty, open to train."""
    monkeypatch.setattr("hmasd_jax.training.seed_run.to_json", lambda config: {})
    config = SimpleNamespace(keep_checkpoints=1)
    job = SimpleNamespace(run=tmp_path, config=config, loggers=(), report=lambda event: None)
    (tmp_path / "seed_0").mkdir()
    seed = SeedRun(job, 0)
    seed.open(0)
    yield seed
    seed.end("finished")


def test_metrics_are_on_disk_before_the_checkpoint(seed, synced):
    seed.write("train", 40, {"loss": 1.0})
    seed.save(40, {"x": np.zeros(3)})
    seed.write("train", 80, {"loss": 1.0})
    synced.clear()
    seed.save(80, {"x": np.zeros(3)})
    names = [name for name, _ in synced]
    assert names.index("metrics.jsonl") < names.index(unfinished("80.npz"))
    metrics = dict(synced)["metrics.jsonl"]
    assert metrics.count(b"\n") == 2
    assert metrics == metrics_path(seed.job.run, 0).read_bytes()


def test_a_checkpoint_has_its_name_on_disk_before_older_ones_are_deleted(tmp_path, synced):
    folder = tmp_path / "seed_0" / "checkpoints"
    for step in (1, 2):
        checkpoint.save(folder, step, {"x": np.zeros(3)}, {}, keep=1)
    contents = [content for name, content in synced if name == "checkpoints"]
    assert contents == [["1.npz"], ["1.npz", "2.npz"]]
    assert ("seed_0", ["checkpoints"]) in synced
    assert checkpoint.steps(folder) == [2]


def test_records_that_are_moved_away_are_on_disk_before_they_are_gone(tmp_path, synced):
    path = tmp_path / "metrics.jsonl"
    path.write_text(LINE % 40 + LINE % 80)
    metrics_log.keep_until(path, 40)
    removed, names, kept, _ = synced
    assert removed == (metrics_log.REMOVED, (LINE % 80).encode())
    assert names == (tmp_path.name, ["metrics.jsonl", metrics_log.REMOVED])
    assert kept == (unfinished("metrics.jsonl"), (LINE % 40).encode())
    assert path.read_text() == LINE % 40


def test_settings_are_on_disk(tmp_path, synced):
    write_json(tmp_path / "config.json", {"seed": 3})
    assert synced[0] == (unfinished("config.json"), b'{\n  "seed": 3\n}\n')
    assert synced[1] == (tmp_path.name, ["config.json"])


def test_two_processes_can_write_a_file_while_another_reads_it(tmp_path):
    path = tmp_path / "run.json"
    texts = [bytes([letter]) * 100_000 for letter in b"ab"]
    replace(path, texts[0])
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        writes = [pool.submit(_write_often, path, text) for text in texts]
        while not all(write.done() for write in writes):
            assert path.read_bytes() in texts
        for write in writes:
            write.result()
    assert os.listdir(tmp_path) == ["run.json"]


def _write_often(path, text):
    for _ in range(100):
        replace(path, text)


def unfinished(name):
    """Return the name of a file that this process has begun."""
    return f".{name}.{os.getpid()}.tmp"


def test_a_write_that_fails_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / "x.json"
    replace(path, b"old")

    def fail(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="No space left"):
        replace(path, b"new")
    assert [(x.name, x.read_bytes()) for x in tmp_path.iterdir()] == [("x.json", b"old")]


def test_a_file_system_that_cannot_sync_folders_is_no_error(tmp_path, monkeypatch):
    def refuse(descriptor):
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))

    monkeypatch.setattr(os, "fsync", refuse)
    sync_folder(tmp_path)
