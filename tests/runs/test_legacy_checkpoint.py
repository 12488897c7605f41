"""Checkpoints in the old format can be read and resumed."""

import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

from hmasd_jax.cli.main import main
from hmasd_jax.config import to_json
from hmasd_jax.runs import checkpoint
from hmasd_jax.runs.checkpoint import CheckpointError
from hmasd_jax.runs.folder import checkpoint_folder
from hmasd_jax.runs.load import load_run
from tests.helpers.toy import numbers, words

STORED = Path(__file__).parents[1] / "golden" / "checkpoint" / "toy_run"
"""80 environment steps of the toy, written at commit 5faca0e."""


@pytest.fixture
def run(tmp_path):
    return shutil.copytree(STORED, tmp_path / "run")


def test_is_read_exactly(run):
    trained = load_run(run)
    state = trained.state
    assert trained.env_steps == 80
    assert trained.config.placement == "auto"  # recorded under its former name `layout`
    assert int(state.num_updates) == 4
    assert state.fragile.dtype == bool
    bits = np.asarray(state.learner.params["w"]).view(np.uint32)
    assert bits.tolist() == [3231507795, 1078819126, 1073637700]
    assert jax.random.key_data(state.key).tolist() == [1846506472, 1430574090]


def test_is_resumed_as_if_never_interrupted(run, tmp_path):
    assert main(["train", "--run-dir", str(run), "--resume", "--total-env-steps", "320"]) == 0
    whole = tmp_path / "whole"
    assert main(["train", "--run-dir", str(whole), *words(total_env_steps=320)]) == 0
    # The stored numbers come from another compiler, so the last digit of a float may differ.
    for ours, theirs in zip(numbers(run, 0), numbers(whole, 0), strict=True):
        assert ours.pop("kind") == theirs.pop("kind")
        assert ours == pytest.approx(theirs, rel=1e-5)
    ours, theirs = load_run(run).state, load_run(whole).state
    assert (ours.key, ours.num_updates, ours.fragile) == (
        theirs.key,
        theirs.num_updates,
        theirs.fragile,
    )
    np.testing.assert_allclose(ours.learner.params["w"], theirs.learner.params["w"], rtol=1e-5)
    # Of 80, 160, 240 and 320 the newest three are kept, now in the new format.
    names = [path.name for path in checkpoint_folder(run, 0).iterdir()]
    assert sorted(names) == ["160.npz", "240.npz", "320.npz"]


@pytest.mark.parametrize("how", ["flip", "truncate", "delete"])
@pytest.mark.parametrize("item", ["state", "content"])
def test_damage_is_one_error(run, item, how, capfd):
    for path in (checkpoint_folder(run, 0) / "80" / item).rglob("*"):
        data = path.read_bytes() if path.is_file() else b""
        middle = len(data) // 2
        if data and how == "delete":
            path.unlink()
        elif data:
            rest = bytes([data[middle] ^ 1]) + data[middle + 1 :] if how == "flip" else b""
            path.write_bytes(data[:middle] + rest)
    with pytest.raises(CheckpointError, match=r"checkpoints/80 is damaged: .*another run folder"):
        load_run(run)
    assert capfd.readouterr() == ("", "")


def test_other_structure_and_configuration_are_named(run):
    template = {"w": jax.ShapeDtypeStruct((3,), np.float32)}
    config = load_run(run).config
    folder = checkpoint_folder(run, 0)
    with pytest.raises(CheckpointError, match=r"state\.fragile is bool\[\], expected absent"):
        checkpoint.restore(folder, template, to_json(config))
    with pytest.raises(CheckpointError, match=r"seed \(saved 0, now 1\)"):
        checkpoint.restore(folder, template, to_json(config) | {"seed": 1})
