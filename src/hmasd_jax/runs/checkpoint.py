"""Checkpoints: the whole train state, saved atomically and read back bit for bit.

The checkpoints of one seed are files `<environment steps>.npz` in one folder. Each holds every
array of the state under its path in the pytree, e.g. `.learner.params['w']`, and under `config` the
configuration of the run as JSON. Typed PRNG keys are stored as their key data.

A state of HMASD has about 180 arrays with 2 MB in total. NumPy writes them to one file and keeps a
checksum of each array. Orbax writes 15 files, takes 15 times as long, has no checksum of the data,
and waits for all JAX processes, although each process of a sweep saves its own seeds.
"""

import errno
import io
import json
import shutil
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hmasd_jax.config import identity
from hmasd_jax.runs import legacy_checkpoint
from hmasd_jax.runs.durable import replace, sync_folder
from hmasd_jax.runs.legacy_checkpoint import ForeignCheckpointError
from hmasd_jax.types import Algorithm
from hmasd_jax.validation import parse_index

State = Any
"""A pytree of arrays, which may include typed PRNG keys."""


class CheckpointError(RuntimeError):
    """A checkpoint cannot be saved or read; the message is one line with the remedy."""


def save(folder: Path, step: int, state: State, config: dict, keep: int) -> None:
    """Save `state` as checkpoint `step`, in place of an earlier one of the same step.

    The checkpoint is on disk when this returns. The oldest checkpoints beyond `keep` are deleted.

    Args:
        folder: Folder for the checkpoints of one seed; created if it does not exist.
        step: Environment steps done so far.
        state: The whole train state.
        config: Resolved configuration, of JSON types. `restore` requires an equal one.
        keep: Number of newest checkpoints to keep.

    Raises:
        CheckpointError: The disk is full or not writable (earlier checkpoints stay as they are),
            or `folder` holds a later step.
    """
    newest = latest_step(folder)
    if newest is not None and newest > step:
        raise CheckpointError(
            f"cannot save step {step}: {checkpoint_path(folder, newest)} is later; use another "
            "run folder, or delete later checkpoints"
        )
    leaves = _named_leaves(state)
    arrays: dict[str, Any] = {name: np.asarray(_key_data(x)) for name, x in leaves.items()}
    # Via memory: if a write fails, np.savez otherwise reports errors a second time on cleanup.
    buffer = io.BytesIO()
    np.savez(buffer, config=np.array(json.dumps(config)), **arrays)
    folder = Path(folder)
    try:
        if not folder.exists():
            folder.mkdir(parents=True)
            sync_folder(folder.parent)
        replace(folder / f"{step}.npz", buffer.getbuffer())
        _prune(folder, keep)
    except OSError as error:
        raise CheckpointError(_save_failure(folder, step, error)) from error


def latest_step(folder: Path) -> int | None:
    """Return the environment steps of the newest checkpoint, or None if there is none."""
    return max(steps(folder), default=None)


def steps(folder: Path) -> list[int]:
    """Return the environment steps of all checkpoints in ascending order."""
    if not Path(folder).is_dir():
        return []
    found = {_step_of(path) for path in Path(folder).iterdir()}
    return sorted(step for step in found if step is not None)


def _step_of(path: Path) -> int | None:
    """Return the environment steps in the name of a checkpoint; None for any other file."""
    return parse_index(path.name.removesuffix(".npz"))


def checkpoint_path(folder: Path, step: int) -> Path:
    """Return the file of a checkpoint, or its folder if an older version has written it."""
    file, legacy = Path(folder) / f"{step}.npz", Path(folder) / str(step)
    return legacy if legacy.is_dir() and not file.exists() else file


def state_template(algorithm: Algorithm) -> State:
    """Return the shapes and dtypes of one seed's train state, as `restore` takes them."""
    return jax.eval_shape(algorithm.init, jax.random.key(0))


def restore(
    folder: Path, template: State, config: dict, step: int | None = None
) -> tuple[State, int]:
    """Read a checkpoint.

    Args:
        folder: Folder with the checkpoints of one seed.
        template: Arrays or `jax.ShapeDtypeStruct`s of the expected structure, e.g. from
            `state_template`. Each array goes to the sharding of its leaf, or to the default
            device if the leaf has none.
        config: Resolved configuration. It must equal the saved one except for
            `config.EXTENSIBLE`.
        step: Environment steps of the checkpoint; None selects the newest.

    Returns:
        The state, and the environment steps done when it was saved.

    Raises:
        CheckpointError: There is no such checkpoint, its files are damaged, or it belongs to a
            state of other structure or shapes or to another configuration.
    """
    available = steps(folder)
    if not available:
        raise CheckpointError(f"no checkpoint in {folder}: train first, or check the path")
    step = available[-1] if step is None else step
    if step not in available:
        known = ", ".join(str(s) for s in available)
        raise CheckpointError(f"no checkpoint of step {step} in {folder}, but of {known}")
    path = checkpoint_path(folder, step)
    try:
        return _read(path, template, config), step
    except CheckpointError:
        raise
    except Exception:  # damage surfaces as many types, from JSON to zip errors
        if path.exists():
            remedy = _remedy(folder, [s for s in available if s < step], template, config)
            message = f"{path} is damaged: {remedy}"
        else:
            message = f"{path} was deleted by training while it was read: read a newer one"
    raise CheckpointError(message)


def _read(path: Path, template: State, config: dict) -> State:
    """Read one checkpoint.

    Raises:
        CheckpointError: The checkpoint does not fit `template` or `config`.
        Exception: Any other type means that the files are damaged.
    """
    try:
        saved_config, arrays = legacy_checkpoint.read(path) if path.is_dir() else _read_npz(path)
    except (ForeignCheckpointError, ImportError) as error:
        raise CheckpointError(str(error)) from error
    _check_config(path, saved_config, config)
    expected = _named_leaves(template)
    _check_structure(path, arrays, expected)
    leaves = [_place(arrays[name], leaf) for name, leaf in expected.items()]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def _read_npz(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    """Return the configuration and the arrays by name."""
    with zipfile.ZipFile(path) as archive:
        if (name := archive.testzip()) is not None:
            raise ValueError(f"the checksum of {name} differs")
    with np.load(path) as file:
        arrays = dict(file)
    return json.loads(arrays.pop("config").item()), arrays


def _named_leaves(tree: State) -> dict[str, Any]:
    """Return the leaves by their paths, in the order of `jax.tree.leaves`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}


def _place(array: np.ndarray, leaf: Any) -> jax.Array:
    """Return `array` as a JAX array of the kind of `leaf` and at its place."""
    # A copy: JAX would otherwise read NumPy's memory, and overwrite it when donated.
    placed = jnp.array(_with_dtype(array, leaf))
    placed = jax.random.wrap_key_data(placed) if _is_key(leaf) else placed
    return jax.device_put(placed, getattr(leaf, "sharding", None))


def _with_dtype(array: np.ndarray, leaf: Any) -> np.ndarray:
    """Restore a dtype that NumPy's files do not know, e.g. bfloat16, which they call `|V2`."""
    return array.view(leaf.dtype) if array.dtype.kind == "V" else array


def _key_data(x: jax.Array) -> jax.Array:
    """Return the integers that a key is made of; other arrays are returned as they are."""
    return jax.random.key_data(x) if _is_key(x) else x


def _is_key(x: Any) -> bool:
    return jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)


def _check_config(path: Path, saved: dict, config: dict) -> None:
    """Raise an error that names the fields that differ.

    A field that the saved configuration lacks was added after the checkpoint was written. Its
    default is the behavior of that time, so it is not a difference.
    """
    old, new = identity(saved), identity(json.loads(json.dumps(config)))  # tuples become lists
    fields = [k for k in sorted(old) if old[k] != new.get(k, "absent")]
    if fields:
        changes = [f"{k} (saved {old[k]}, now {new.get(k, 'absent')})" for k in fields]
        raise CheckpointError(
            f"{path} is of another configuration: {', '.join(changes)}; "
            "use the saved values, or another run folder"
        )


def _check_structure(path: Path, arrays: dict[str, np.ndarray], expected: dict[str, Any]) -> None:
    """Raise an error that names the first array that differs."""
    for name in sorted(arrays | expected):
        saved, leaf = "absent", "absent"
        if name in expected:
            like = jax.eval_shape(_key_data, expected[name])
            leaf = f"{like.dtype}{list(like.shape)}"
        if name in arrays:
            array = _with_dtype(arrays[name], expected.get(name, arrays[name]))
            saved = f"{array.dtype}{list(array.shape)}"
        if saved != leaf:
            raise CheckpointError(
                f"{path} is of another algorithm, environment or version: state{name} is "
                f"{saved}, expected {leaf}; use another run folder"
            )


def _remedy(folder: Path, earlier: list[int], template: State, config: dict) -> str:
    """Find an earlier step to use instead of a damaged one."""
    for step in reversed(earlier):
        try:
            _read(checkpoint_path(folder, step), template, config)
        except Exception:  # damaged as well
            continue
        return f"delete it to continue from step {step}, which is intact"
    return "no earlier checkpoint is intact; train again in another run folder"


def _prune(folder: Path, keep: int) -> None:
    """Delete old checkpoints, older formats of the newest, and what killed saves have left."""
    kept = {checkpoint_path(folder, step).name for step in steps(folder)[-keep:]}
    for path in folder.iterdir():
        is_checkpoint = _step_of(path) is not None
        if (is_checkpoint and path.name not in kept) or "tmp" in path.name:
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def _save_failure(folder: Path, step: int, error: OSError) -> str:
    """Describe a failed save in one line."""
    full = error.errno == errno.ENOSPC
    reason = "the disk is full" if full else error.strerror or repr(error)
    newest = latest_step(folder)
    usable = "there is no earlier one" if newest is None else f"step {newest} stays usable"
    remedy = "free some space and resume" if full else "make the folder writable and resume"
    return f"cannot save {Path(folder) / f'{step}.npz'}: {reason}; {usable}; {remedy}"
