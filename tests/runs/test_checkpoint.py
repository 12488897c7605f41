import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from hmasd_jax.runs import checkpoint
from hmasd_jax.runs.checkpoint import CheckpointError

CONFIG = {"algorithm": {"name": "hmasd", "sizes": (8, 8), "coef": 0.1}, "seed": 0}


class State(NamedTuple):
    key: jax.Array
    first: jax.Array
    params: dict
    opt_state: Any


def make_state(key: jax.Array, size: int = 8) -> State:
    params = {
        "kernel": jax.random.normal(key, (size, size)),
        "bias": -jnp.zeros(size),
        "half": jax.random.normal(key, (2,), jnp.bfloat16),
        "none": jnp.zeros((0, size)),
    }
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(1e-3))
    return State(key, jnp.array([True, False, True]), params, optimizer.init(params))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Checkpoints of steps 100, 200 and 300; that of step s is `make_state(key(s))`."""
    for step in (100, 200, 300):
        checkpoint.save(tmp_path / "checkpoints", step, make_state(jax.random.key(step)), CONFIG, 3)
    return tmp_path / "checkpoints"


@pytest.fixture(scope="session")
def template() -> State:
    return jax.eval_shape(make_state, jax.random.key(0))


def assert_identical(actual, expected):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected)):
        assert a.dtype == b.dtype
        if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        assert a.shape == b.shape
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()  # also tells -0.0 from 0.0


def damage(path: Path, how: str) -> None:
    data = path.read_bytes()
    middle = len(data) // 2
    if how == "truncate":
        path.write_bytes(data[:middle])
    elif how == "empty":
        path.write_bytes(b"")
    else:
        path.write_bytes(data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :])


def test_restores_newest_exactly(folder, template):
    state, step = checkpoint.restore(folder, template, CONFIG)
    assert step == 300
    assert type(state) is State
    assert_identical(state, make_state(jax.random.key(300)))


def test_restores_chosen_step_and_vmapped_state(folder, template, tmp_path):
    state, step = checkpoint.restore(folder, template, CONFIG, step=200)
    assert step == 200
    assert_identical(state, make_state(jax.random.key(200)))

    many = jax.vmap(make_state)(jax.random.split(jax.random.key(0), 3))
    checkpoint.save(tmp_path / "many", 0, many, CONFIG, 1)
    assert_identical(checkpoint.restore(tmp_path / "many", many, CONFIG)[0], many)


def test_restored_state_can_be_donated(folder, template):
    state, _ = checkpoint.restore(folder, template, CONFIG)
    params = jax.jit(lambda p: jax.tree.map(lambda x: x + 1, p), donate_argnums=0)(state.params)
    expected = make_state(jax.random.key(300)).params
    assert_identical(params, jax.tree.map(lambda x: x + 1, expected))
    assert_identical(checkpoint.restore(folder, template, CONFIG)[0].params, expected)


def test_keeps_the_newest(tmp_path):
    for step in (1, 2, 3, 10):
        checkpoint.save(tmp_path, step, make_state(jax.random.key(step)), CONFIG, keep=2)
    assert checkpoint.steps(tmp_path) == [3, 10]
    assert checkpoint.latest_step(tmp_path) == 10


def test_saving_replaces_the_same_step(folder, template):
    checkpoint.save(folder, 300, make_state(jax.random.key(7)), CONFIG, 3)
    state, _ = checkpoint.restore(folder, template, CONFIG)
    assert_identical(state, make_state(jax.random.key(7)))
    assert checkpoint.steps(folder) == [100, 200, 300]


def test_refuses_to_save_before_a_later_step(folder):
    with pytest.raises(CheckpointError, match=r"step 250: .*checkpoints/300.npz is later.*delete"):
        checkpoint.save(folder, 250, make_state(jax.random.key(0)), CONFIG, 3)
    assert checkpoint.steps(folder) == [100, 200, 300]


def test_nothing_there(tmp_path, folder, template):
    assert checkpoint.latest_step(tmp_path / "no") is None
    with pytest.raises(CheckpointError, match=r"no checkpoint in .*/no: train first"):
        checkpoint.restore(tmp_path / "no", template, CONFIG)
    with pytest.raises(CheckpointError, match=r"no checkpoint of step 5 in .*, but of 100, 200"):
        checkpoint.restore(folder, template, CONFIG, step=5)


def test_unfinished_saves_are_ignored_and_cleared(folder, template):
    (folder / "400.tmp").write_bytes((folder / "300.npz").read_bytes()[:100])
    (folder / "400.orbax-checkpoint-tmp").mkdir()  # from a killed run in the old format
    assert checkpoint.latest_step(folder) == 300
    assert checkpoint.restore(folder, template, CONFIG)[1] == 300
    checkpoint.save(folder, 400, make_state(jax.random.key(400)), CONFIG, 3)
    assert sorted(p.name for p in folder.iterdir()) == ["200.npz", "300.npz", "400.npz"]


@pytest.mark.parametrize("how", ["truncate", "empty", "flip"])
def test_damage_names_the_intact_step(folder, template, how, capfd):
    damage(folder / "300.npz", how)
    damage(folder / "200.npz", "truncate")
    with pytest.raises(CheckpointError) as error:
        checkpoint.restore(folder, template, CONFIG)
    assert str(error.value) == (
        f"{folder / '300.npz'} is damaged: delete it to continue from step 100, which is intact"
    )
    assert checkpoint.restore(folder, template, CONFIG, step=100)[1] == 100
    assert capfd.readouterr() == ("", "")


def test_no_flipped_byte_goes_unnoticed(tmp_path, template):
    expected = make_state(jax.random.key(1))
    checkpoint.save(tmp_path, 1, expected, CONFIG, 1)
    file = tmp_path / "1.npz"
    data = file.read_bytes()
    noticed = 0
    for position in range(0, len(data), 29):
        flipped = bytes([data[position] ^ (1 << position % 8)])
        file.write_bytes(data[:position] + flipped + data[position + 1 :])
        try:
            state, _ = checkpoint.restore(tmp_path, template, CONFIG)
        except CheckpointError as error:
            assert "is damaged" in str(error)  # noqa: PT017 (not all bytes of an archive matter)
            noticed += 1
        else:
            assert_identical(state, expected)
    assert noticed > 100


def test_a_checkpoint_deleted_while_it_is_read(folder, template, monkeypatch):
    def read(path):
        path.unlink()
        raise FileNotFoundError(path)

    monkeypatch.setattr(checkpoint, "_read_npz", read)
    with pytest.raises(CheckpointError, match=r"/100.npz was deleted by training"):
        checkpoint.restore(folder, template, CONFIG, step=100)


def test_all_damaged(folder, template):
    for step in (100, 200, 300):
        damage(folder / f"{step}.npz", "empty")
    with pytest.raises(CheckpointError, match="no earlier checkpoint is intact"):
        checkpoint.restore(folder, template, CONFIG)


def test_other_configuration_names_the_fields(folder, template):
    now = {"algorithm": {"name": "hmasd", "sizes": [8, 8], "coef": 0.2}}
    with pytest.raises(CheckpointError) as error:
        checkpoint.restore(folder, template, now)
    assert str(error.value) == (
        f"{folder / '300.npz'} is of another configuration: algorithm.coef (saved 0.1, now 0.2), "
        "seed (saved 0, now absent); use the saved values, or another run folder"
    )


def test_a_setting_younger_than_the_checkpoint_is_no_difference(folder, template):
    _, step = checkpoint.restore(folder, template, {**CONFIG, "new_option": 0})
    assert step == 300


def test_other_shapes_and_other_structure(folder, template):
    wider = jax.eval_shape(lambda key: make_state(key, 16), jax.random.key(0))
    with pytest.raises(CheckpointError, match=r"bias'\] is float32\[8\], expected float32\[16\]"):
        checkpoint.restore(folder, wider, CONFIG)
    with pytest.raises(CheckpointError, match=r"state\.opt_state.* is int32\[\], expected absent"):
        checkpoint.restore(folder, template._replace(opt_state=()), CONFIG)


def test_checkpoint_of_another_program(tmp_path, template):
    (tmp_path / "5" / "state").mkdir(parents=True)
    with pytest.raises(CheckpointError, match=r"/5 was not written by hmasd_jax"):
        checkpoint.restore(tmp_path, template, CONFIG)


def test_full_disk_leaves_earlier_checkpoints(folder, template, monkeypatch):
    def fail(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(CheckpointError) as error:
        checkpoint.save(folder, 400, make_state(jax.random.key(400)), CONFIG, keep=1)
    assert str(error.value) == (
        f"cannot save {folder / '400.npz'}: the disk is full; step 300 stays usable; "
        "free some space and resume"
    )
    assert sorted(p.name for p in folder.iterdir()) == ["100.npz", "200.npz", "300.npz"]
    assert checkpoint.restore(folder, template, CONFIG)[1] == 300


SCRIPT = """
import os, resource, signal, sys, threading
from pathlib import Path
import numpy as np
from hmasd_jax.runs import checkpoint

folder = Path(sys.argv[1])
noise = np.random.default_rng(0).integers(0, 255, 40_000_000).astype(np.uint8)

def die_while_writing():
    while not any("tmp" in path.name for path in folder.iterdir()):
        pass
    os.kill(os.getpid(), signal.SIGKILL)

checkpoint.save(folder, 1, {"x": noise}, {}, keep=1)
resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, resource.RLIM_INFINITY))
try:
    checkpoint.save(folder, 2, {"x": noise + 1}, {}, keep=1)
except checkpoint.CheckpointError as error:
    print(error, flush=True)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
threading.Thread(target=die_while_writing).start()
checkpoint.save(folder, 3, {"x": noise + 2}, {}, keep=1)
print("not killed", flush=True)
"""


def test_failed_write_and_kill_within_a_write(tmp_path):
    folder = tmp_path / "checkpoints"
    child = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(folder)], capture_output=True, text=True, timeout=120
    )
    assert child.returncode == -signal.SIGKILL
    assert child.stdout.startswith(f"cannot save {folder / '2.npz'}: ")
    assert child.stdout.count("\n") == 1
    assert "step 1 stays usable" in child.stdout
    assert child.stderr == ""
    assert any("tmp" in path.name for path in folder.iterdir())

    template = {"x": jax.ShapeDtypeStruct((40_000_000,), np.uint8)}
    state, step = checkpoint.restore(folder, template, {})
    assert step == 1
    noise = np.random.default_rng(0).integers(0, 255, 40_000_000).astype(np.uint8)
    np.testing.assert_array_equal(state["x"], noise)
    checkpoint.save(folder, 3, state, {}, keep=1)
    assert [path.name for path in folder.iterdir()] == ["3.npz"]


def test_numpy_alone_reads_a_checkpoint(folder):
    with np.load(folder / "300.npz") as arrays:
        saved = json.loads(arrays["config"].item())
        kernel = arrays[".params['kernel']"]
    assert saved["algorithm"] == {"name": "hmasd", "sizes": [8, 8], "coef": 0.1}
    np.testing.assert_array_equal(kernel, make_state(jax.random.key(300)).params["kernel"])


class Intruder:
    """An object whose unpickling writes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.mark.parametrize("name", ["config", "state.key", ".params['kernel']"])
def test_a_checkpoint_from_a_stranger_runs_no_code(name, tmp_path, folder, template):
    """Check that no object is unpickled, wherever it is in the file."""
    written = tmp_path / "written"
    arrays = dict(np.load(folder / "300.npz"))
    arrays[name] = np.array([Intruder(written)], dtype=object)
    np.savez(folder / "300.npz", **arrays)
    with pytest.raises(CheckpointError, match=r"300.npz is damaged: delete it to continue"):
        checkpoint.restore(folder, template, CONFIG)
    assert not written.exists()
    with np.load(folder / "300.npz", allow_pickle=True) as file:  # It would have.
        file[name]
    assert written.exists()
