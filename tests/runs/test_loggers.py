"""TensorBoard and Weights & Biases, without their packages' own files and servers."""

import sys
from types import SimpleNamespace

import pytest

from hmasd_jax.runs import metrics_log

RECORD = {"kind": "eval", "seed": 3, "env_steps": 80, "wall_seconds": 1.0, "success": 0.5}


def test_weights_and_biases_get_every_number_under_its_kind(tmp_path, monkeypatch):
    logged, started = [], {}
    run = SimpleNamespace(
        define_metric=lambda *_, **__: None, log=logged.append, finish=lambda: logged.append("end")
    )
    wandb = SimpleNamespace(init=lambda **more: started.update(more) or run)
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    (tmp_path / "seed_3").mkdir()
    for writer in metrics_log.open_writers(tmp_path, 3, {}, -1, ("wandb",)):
        writer.write(RECORD)
        writer.sync()
        writer.close()
    assert (started["group"], started["name"]) == (tmp_path.name, f"{tmp_path.name}/seed_3")
    assert logged == [{"env_steps": 80, "eval/wall_seconds": 1.0, "eval/success": 0.5}, "end"]


def test_tensorboard_hides_what_a_resume_trains_again(tmp_path, monkeypatch):
    pytest.importorskip("tensorboardX")
    made = []
    monkeypatch.setattr("tensorboardX.SummaryWriter", lambda *a, **more: made.append((a, more)))
    metrics_log.TensorBoard(tmp_path, 80)
    assert made == [((str(tmp_path),), {"purge_step": 81})]
