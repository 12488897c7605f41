"""Checkpoints: the whole train state, saved atomically, read back bit for bit.

A folder of checkpoints holds one subfolder per saved step. Each was written under a temporary
name and then renamed, so one that bears its final name is complete. It holds three items:

- `state`: the bytes of all arrays, one after the other. As a single array it is written and read
  in a fraction of the time of hundreds of small ones, does not depend on the devices it was on, and
  damage is one error rather than one per array.
- `content`: name, dtype and shape of these arrays in order, and the checksum of the bytes.
- `config`: the configuration that the state belongs to.
"""

import errno
import json
import logging
import shutil
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import orbax.checkpoint as ocp

from hmasd_jax.config import identity
from hmasd_jax.runs.packing import describe, from_bytes, to_bytes

State = Any
"""A pytree of arrays, typed PRNG keys among them."""


class CheckpointError(RuntimeError):
    """A checkpoint cannot be saved or read; the message is one line that says what to do."""


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep orbax's remarks off the console: all that users need is in `CheckpointError`."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(level)


@_quiet()
def save(folder: Path, step: int, state: State, config: dict, keep: int) -> None:
    """Save `state` as checkpoint `step`; returns when it is on disk.

    Saving a step that is there already with the same content does nothing.

    Args:
        folder: of the checkpoints of one seed; created if need be.
        step: environment steps done so far.
        state: the whole train state.
        config: resolved configuration, of JSON types; `restore` insists on the same.
        keep: number of newest checkpoints that stay.

    Raises:
        CheckpointError: the disk is full or not writable (earlier checkpoints stay as they are),
            or `folder` holds a later step.
    """
    data = to_bytes(state)
    content = {"leaves": describe(state), "size": len(data), "checksum": zlib.crc32(data)}
    newest = latest_step(folder)
    if newest is not None and newest > step:
        raise CheckpointError(
            f"{_path(folder, newest)} is later than step {step}, which was to be saved beside it: "
            "use another run folder, or delete the later checkpoints"
        )
    if newest == step:
        if _holds(folder, step, content, config):
            return
        shutil.rmtree(_path(folder, step))
    items = ocp.args.Composite(
        state=ocp.args.StandardSave({"bytes": np.frombuffer(data, np.uint8)}),
        config=ocp.args.JsonSave(config),
        content=ocp.args.JsonSave(content),
    )
    try:
        # Temporary folders are what a killed or failed save has left behind.
        with _manager(folder, max_to_keep=keep, cleanup_tmp_directories=True) as manager:
            manager.save(step, args=items, force=True)
    except Exception as error:  # the array writer reports a full disk in several types
        _remove_unfinished(folder)
        raise CheckpointError(_save_failure(folder, step, error)) from error


def latest_step(folder: Path) -> int | None:
    """Environment steps of the newest complete checkpoint, None if there is none."""
    return max(steps(folder), default=None)


@_quiet()
def steps(folder: Path) -> list[int]:
    """Environment steps of all complete checkpoints, ascending."""
    if not Path(folder).is_dir():
        return []
    with _manager(folder, read_only=True) as manager:
        return sorted(manager.all_steps())


@_quiet()
def restore(
    folder: Path, template: State, config: dict, step: int | None = None
) -> tuple[State, int]:
    """Read a checkpoint.

    Args:
        folder: of the checkpoints of one seed.
        template: arrays or `jax.ShapeDtypeStruct`s of the expected structure, as from
            `jax.eval_shape(algorithm.init, key)`. Leaves without a sharding go to one device.
        config: resolved configuration; must equal the saved one but for `config.EXTENSIBLE`.
        step: environment steps of the checkpoint; None is the newest.

    Returns:
        The state, and the environment steps done when it was saved.

    Raises:
        CheckpointError: nothing there, damaged files, a state of other structure or shapes, or
            another configuration.
    """
    available = steps(folder)
    if not available:
        raise CheckpointError(f"no checkpoint in {folder}: train first, or check the path")
    step = available[-1] if step is None else step
    if step not in available:
        known = ", ".join(str(s) for s in available)
        raise CheckpointError(f"no checkpoint of step {step} in {folder}: there are {known}")
    try:
        return _read(folder, step, template, config), step
    except CheckpointError:
        raise
    except Exception:  # damage surfaces as any type, from JSON to array decoding
        remedy = _remedy(folder, [s for s in available if s < step], template, config)
        message = f"{_path(folder, step)} is damaged: {remedy}"
    raise CheckpointError(message)


def _read(folder: Path, step: int, template: State, config: dict) -> State:
    """The state of one step; raises `CheckpointError` for a mismatch, anything for damage."""
    path = _path(folder, step)
    if (path / "state").is_dir() and not (path / "content").is_dir():
        raise CheckpointError(
            f"{path} was not written by hmasd_jax: choose a run folder of this library"
        )
    with _manager(folder, read_only=True) as manager:
        saved_config, content = _read_json(manager, step)
        _check_config(path, saved_config, config)
        _check_structure(path, content["leaves"], describe(template))
        like = {"bytes": np.empty(content["size"], np.uint8)}
        items = ocp.args.Composite(state=ocp.args.StandardRestore(like))
        data = manager.restore(step, args=items)["state"]["bytes"].tobytes()
    if zlib.crc32(data) != content["checksum"]:
        raise ValueError("the checksum differs")
    return from_bytes(data, template)


def _read_json(manager: ocp.CheckpointManager, step: int) -> tuple[dict, dict]:
    """What was saved beside the state: configuration and content."""
    args = ocp.args.Composite(config=ocp.args.JsonRestore(), content=ocp.args.JsonRestore())
    items = manager.restore(step, args=args)
    return items["config"], items["content"]


def _holds(folder: Path, step: int, content: dict, config: dict) -> bool:
    """Whether the checkpoint says to be of this state and configuration."""
    try:
        with _manager(folder, read_only=True) as manager:
            return _read_json(manager, step) == (_as_json(config), content)
    except Exception:  # damaged, so there is nothing to lose in replacing it
        return False


def _check_config(path: Path, saved: dict, config: dict) -> None:
    """Name the fields that differ.

    A setting that the saved configuration lacks is younger than the checkpoint: its default is
    what the code did then. How far the run goes may change.
    """
    old, new = identity(saved), identity(_as_json(config))
    fields = [k for k in sorted(old) if old[k] != new.get(k, "absent")]
    if fields:
        changes = [f"{k} (saved {_show(old, k)}, now {_show(new, k)})" for k in fields]
        raise CheckpointError(
            f"{path} is of another configuration: {', '.join(changes)}; "
            "use the saved values, or another run folder"
        )


def _check_structure(path: Path, saved: dict, expected: dict) -> None:
    """Name the first array that differs."""
    for name in sorted(saved | expected):
        if saved.get(name) != expected.get(name):
            raise CheckpointError(
                f"{path} is of another algorithm, environment or version: state{name} is "
                f"{_show(saved, name)}, expected {_show(expected, name)}; use another run folder"
            )


def _remedy(folder: Path, earlier: list[int], template: State, config: dict) -> str:
    """Which earlier step can be used instead of a damaged one."""
    for step in reversed(earlier):
        try:
            _read(folder, step, template, config)
        except Exception:  # damaged as well
            continue
        return f"delete it to go on from step {step}, which is intact"
    return "no earlier checkpoint is intact; train again in another run folder"


def _save_failure(folder: Path, step: int, error: Exception) -> str:
    """One line for whatever went wrong in a save."""
    text = str(error)
    full = getattr(error, "errno", None) == errno.ENOSPC or "No space left" in text
    reason = "the disk is full" if full else text.splitlines()[0] if text else repr(error)
    newest = latest_step(folder)
    usable = "there is no earlier one" if newest is None else f"step {newest} stays usable"
    remedy = "free some space and resume" if full else "make the folder writable and resume"
    return f"cannot save {_path(folder, step)}: {reason}; {usable}; {remedy}"


def _remove_unfinished(folder: Path) -> None:
    """Free the space that a failed save takes."""
    for path in Path(folder).glob("*.orbax-checkpoint-tmp*"):
        shutil.rmtree(path, ignore_errors=True)


@contextmanager
def _manager(folder: Path, **options: Any) -> Iterator[ocp.CheckpointManager]:
    """Orbax's view of the folder as it is now.

    Made anew for every call (a millisecond), so that nothing is cached and nothing is left open
    when a run is killed.
    """
    settings = ocp.CheckpointManagerOptions(enable_async_checkpointing=False, **options)
    with _open(Path(folder).absolute(), settings) as manager:
        yield manager


def _open(folder: Path, settings: ocp.CheckpointManagerOptions) -> ocp.CheckpointManager:
    """Try again if a training process deletes an old checkpoint while orbax lists them all."""
    for _ in range(10):
        with suppress(FileNotFoundError, NotADirectoryError):
            return ocp.CheckpointManager(folder, options=settings)
    return ocp.CheckpointManager(folder, options=settings)


def _path(folder: Path, step: int) -> Path:
    return Path(folder) / str(step)


def _as_json(config: dict) -> dict:
    """What `config` becomes on disk: tuples turn into lists."""
    return json.loads(json.dumps(config))


def _show(fields: dict, name: str) -> str:
    return str(fields[name]) if name in fields else "absent"
