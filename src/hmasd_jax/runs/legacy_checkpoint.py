"""Reader for the checkpoints of early runs, so that they can still be loaded and resumed.

They are folders that orbax has written, with three items:

- `state`: the bytes of all arrays, one after the other, as one array of uint8;
- `content`: name, dtype and shape of the arrays in order, and the CRC-32 of the bytes;
- `config`: the configuration of the run.
"""

import json
import math
import zlib
from pathlib import Path

import numpy as np


class ForeignCheckpointError(ValueError):
    """The folder was written by another program."""


def read(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    """Read a checkpoint; keys are returned as their key data.

    Args:
        path: Folder of one checkpoint.

    Returns:
        The configuration, and the arrays by name.

    Raises:
        ForeignCheckpointError: The folder was written by another program.
        ImportError: The package tensorstore is not installed.
        Exception: Any other type means that the files are damaged.
    """
    if not (path / "content").is_dir():
        raise ForeignCheckpointError(
            f"{path} was not written by hmasd_jax: choose a run folder of this library"
        )
    config = json.loads((path / "config" / "metadata").read_text())
    content = json.loads((path / "content" / "metadata").read_text())
    data = _read_bytes(path / "state")
    if zlib.crc32(data) != content["checksum"]:
        raise ValueError("the checksum differs")
    arrays, begin = {}, 0
    for name, description in content["leaves"].items():
        dtype, shape = _parse(description)
        arrays[name] = np.frombuffer(data, dtype, math.prod(shape), begin).reshape(shape)
        begin += arrays[name].nbytes
    return config, arrays


def _read_bytes(folder: Path) -> bytes:
    """Read the array `bytes`."""
    try:
        import tensorstore  # comes with flax
    except ImportError as error:
        raise ImportError(
            f"{folder} is in an old format that needs tensorstore: pip install tensorstore"
        ) from error
    store = {"driver": "ocdbt", "base": folder.absolute().as_uri() + "/", "path": "bytes/"}
    array = tensorstore.open({"driver": "zarr", "kvstore": store}, open=True).result()
    return array.read().result().tobytes()


def _parse(description: str) -> tuple[str, tuple[int, ...]]:
    """Split a description such as `float32[8, 4]`; `key<fry>` has two integers per key."""
    dtype, _, axes = description.removesuffix("]").partition("[")
    shape = tuple(int(axis) for axis in axes.split(",") if axis)
    return ("uint32", (*shape, 2)) if dtype == "key<fry>" else (dtype, shape)
