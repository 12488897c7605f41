"""Files that outlast a power cut.

A system writes to the disk later, and in any order, unless a program waits for it.
"""

import errno
import os
from pathlib import Path
from typing import IO

UNSYNCED = {errno.EINVAL, errno.EACCES, errno.EPERM, errno.ENOTSUP}
"""Errors of systems that cannot open a folder, or wait for it."""


def sync(file: IO) -> None:
    """Wait until all that was written to a file is on disk."""
    file.flush()
    os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Wait until the names in a folder are on disk, where the system can."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in UNSYNCED:
            raise


def replace(path: Path, data: bytes | memoryview) -> None:
    """Write a file atomically: after a kill or a power cut it is either old or new.

    It is on disk when this returns. Where several processes write it, each does so atomically.
    """
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with unfinished.open("wb") as file:
            file.write(data)
            sync(file)
        unfinished.replace(path)
    except OSError:
        unfinished.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)
