"""Optuna's storage of a search: a file in its folder, or what a URL names."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hmasd_jax.runs.folder import RunError
from hmasd_jax.validation import ConfigError

if TYPE_CHECKING:
    import optuna

HIDDEN = "***"
"""Stands for the password of a URL, which is not written down."""


def hide_password(storage: str | None) -> str | None:
    """Return a URL as it may be written down.

    Raises:
        RunError: It is not a URL.
    """
    if storage is None:
        return None
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import ArgumentError

    try:
        return make_url(storage).render_as_string(hide_password=True)
    except ArgumentError as error:
        raise RunError(f"cannot use --storage {storage}: it is not a URL") from error


@contextmanager
def open_storage(folder: Path, place: dict, url: str | None, may_write: bool) -> Iterator[Any]:
    """Yield the storage of a search; whatever goes wrong with it is one error.

    Args:
        folder: Folder of the search.
        place: Contents of its `study.json`.
        url: URL that was given; None takes the one that was written down.
        may_write: If True, the journal is created and mended.
    """
    import optuna
    from sqlalchemy.exc import SQLAlchemyError

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    url = url or place["storage"]
    shown = folder / "journal.log" if url is None else place["storage"] or url
    if url is not None and HIDDEN in url:
        raise RunError(
            f"the storage of {folder} has a password, which is not kept: give its URL as --storage "
            "to tune, or name single trials to the other commands"
        )
    try:
        yield _journal(folder, may_write) if url is None else url
    except (OSError, ValueError, KeyError, ImportError, SQLAlchemyError) as error:
        if isinstance(error, ConfigError):
            raise
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise RunError(f"cannot use the storage {shown} of {folder}: {reason[0]}") from error


@contextmanager
def needs_storage(folder: Path) -> Iterator[None]:
    """Make one error of the loss of a database while its search goes on.

    Raises:
        RunError: The database can no longer be used; the message says how to continue.
    """
    from optuna.exceptions import StorageInternalError
    from sqlalchemy.exc import SQLAlchemyError

    try:
        yield
    except (StorageInternalError, SQLAlchemyError) as error:
        reason = str(error.__cause__ or error).splitlines()[0]
        raise RunError(
            f"lost the storage of {folder}: {reason}; what was trained is saved: continue with "
            "--resume when the storage is back"
        ) from error


def _journal(folder: Path, may_write: bool) -> "optuna.storages.BaseStorage":
    """Return the storage in the folder's own file."""
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend, JournalFileSymlinkLock

    path = folder / "journal.log"
    if not may_write and not path.exists():
        raise FileNotFoundError(f"it has no {path.name}")
    lock = JournalFileSymlinkLock(str(path))
    if may_write and path.exists():
        lock.acquire()
        try:
            _mend(path)
        finally:
            lock.release()
    return JournalStorage(JournalFileBackend(str(path), lock_obj=lock))


def _mend(path: Path) -> None:
    """Move the half of a line that a power cut has left at the end of a journal to another file.

    Else the next line would follow it on the same line, and neither could be read.
    """
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        with path.with_name("journal.removed.log").open("ab") as file:
            file.write(content[whole:] + b"\n")
        with path.open("r+b") as file:
            file.truncate(whole)
