"""A search in its folder and in Optuna's storage.

- `preset.json`: the configuration that the trials change.
- `study.json`: where Optuna's storage is.
- `journal.log`: that storage, unless it is a database.
- `trial_<n>/`: the run of trial n. Trial 0 is the preset itself.

What is searched stands in the storage, so that all processes agree on it.
"""

import json
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from envs_jax.optional import require
from hmasd_jax.config import TrainConfig, from_json, identity, read_table, to_json
from hmasd_jax.runs.folder import RunError, exclusive, write_json
from hmasd_jax.search.space import Choices, Space, preset_values, read_space
from hmasd_jax.validation import ConfigError

if TYPE_CHECKING:
    import optuna

LOCK = ".lock"
"""File of the folder that a process holds while it prepares the search or takes a trial."""
HIDDEN = "***"
"""Stands for the password of a URL, which is not written down."""


class Definition(NamedTuple):
    """What is searched, and how trials are judged."""

    config: TrainConfig
    """The preset."""
    settings: list[tuple[str, list[str]]]
    """Dotted name and values of each setting, as typed."""
    last: int
    """Number of last evaluations that count."""
    prune_after: int
    """Number of complete trials from which on worse ones are stopped."""

    def to_json(self) -> dict[str, Any]:
        """Return JSON values."""
        settings = [[name, list(texts)] for name, texts in self.settings]
        return {**self._asdict(), "config": to_json(self.config), "settings": settings}


class Search(NamedTuple):
    """A search that is open."""

    folder: Path
    definition: Definition
    space: Space
    study: "optuna.Study"
    place: str
    """Name of this folder in a storage that folders of several machines share."""
    is_local: bool
    """True if the storage is a file in the folder."""

    @property
    def trials(self) -> int:
        """Number of trials that are wanted."""
        return self.study.user_attrs["trials"]

    @property
    def preset(self) -> dict[str, Any] | None:
        """The preset's own values, None if one is outside the space."""
        return preset_values(self.definition.config, self.space)


def trial_folder(folder: Path, number: int) -> Path:
    """Return the run folder of a trial."""
    return folder / f"trial_{number}"


def is_search(folder: Path) -> bool:
    """Tell whether a folder is that of a search."""
    return (folder / "study.json").is_file()


def create_or_join(
    folder: Path, definition: Definition, trials: int, storage: str | None, name: str | None
) -> Search:
    """Open a search, which is created unless the folder or the storage has it.

    Args:
        folder: Folder of the search.
        definition: What to search.
        trials: Number of trials of all processes.
        storage: URL of Optuna's storage; None for a file in the folder.
        name: Name of the search in the storage; None for that of the folder.

    Raises:
        MissingPackageError: Optuna is not installed.
        RunError: The folder is in use or has another search, or the storage cannot be used.
        ConfigError: The space is not valid.
    """
    require("optuna", "tune", "a search")
    space = read_space(definition.config, definition.settings)
    if folder.exists() and not is_search(folder) and any(folder.glob("[!.]*")):
        raise RunError(f"{folder} is not empty, and not a search: choose another --run-dir")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with exclusive(folder / LOCK):
            if not is_search(folder):
                write_json(folder / "preset.json", to_json(definition.config))
                _write_place(folder, storage, name or folder.resolve().name)
            return _open(folder, storage, definition, space, trials)
    except OSError as error:
        raise RunError(f"cannot write {folder}: {error.strerror or error}") from error


def _write_place(folder: Path, storage: str | None, name: str) -> None:
    """Write where the storage is, without the password of a URL."""
    if storage is not None:
        from sqlalchemy.engine import make_url
        from sqlalchemy.exc import ArgumentError

        try:
            storage = make_url(storage).render_as_string(hide_password=True)
        except ArgumentError as error:
            raise RunError(f"cannot use --storage {storage}: it is not a URL") from error
    place = {"storage": storage, "name": name, "place": uuid.uuid4().hex}
    write_json(folder / "study.json", place)


def _open(
    folder: Path, storage: str | None, definition: Definition, space: Space, trials: int
) -> Search:
    """Open the study of a folder; what is missing in the storage is written."""
    import optuna

    place = read_table(folder / "study.json")
    with _storage(folder, place, storage, may_write=True) as opened:
        study = optuna.create_study(
            storage=opened,
            study_name=place["name"],
            direction="maximize",
            pruner=optuna.pruners.MedianPruner(definition.prune_after, definition.last),
            load_if_exists=True,
        )
        search = Search(folder, definition, space, study, place["place"], place["storage"] is None)
        if "definition" not in study.user_attrs:
            if not study.trials:  # Else a process was killed here.
                study.enqueue_trial(search.preset or {})
            study.set_user_attr("trials", trials)
            study.set_user_attr("definition", definition.to_json())
        _check_same(study.user_attrs["definition"], definition.to_json(), folder)
        if search.trials != trials:
            study.set_user_attr("trials", trials)
    return search


def read_search(folder: Path, storage: str | None = None) -> Search:
    """Read the search of a folder; nothing is written.

    Args:
        folder: Folder of the search.
        storage: URL of its storage, if that has a password.

    Raises:
        MissingPackageError: Optuna is not installed.
        RunError: The folder has no search, or its storage cannot be read.
        ConfigError: Its preset is not valid in this version.
    """
    optuna = require("optuna", "tune", "a search")
    if not is_search(folder):
        raise RunError(f"{folder} is not a search: it has no study.json")
    place = read_table(folder / "study.json")
    with _storage(folder, place, storage, may_write=False) as opened:
        study = optuna.load_study(study_name=place["name"], storage=opened)
        table = study.user_attrs["definition"]
    config = from_json(table["config"])
    settings = [(name, texts) for name, texts in table["settings"]]
    definition = Definition(config, settings, table["last"], table["prune_after"])
    space = read_space(config, settings)
    return Search(folder, definition, space, study, place["place"], place["storage"] is None)


@contextmanager
def _storage(folder: Path, place: dict, url: str | None, may_write: bool) -> Iterator[Any]:
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


def _check_same(saved: dict[str, Any], wanted: dict[str, Any], folder: Path) -> None:
    """Check that a search is joined with its own definition.

    Raises:
        RunError: It differs; the message says where.
    """

    def flat(table: dict[str, Any]) -> dict[str, Any]:
        config = table["config"]
        lengths = {name: config[name] for name in ("total_env_steps", "num_seeds")}
        vary = [f"{name}={','.join(texts)}" for name, texts in table["settings"]]
        judged = {name: table[name] for name in ("last", "prune_after")}
        return {"vary": vary, **judged, **lengths, **identity(config)}

    old, new = flat(saved), flat(json.loads(json.dumps(wanted)))
    changed = [name for name in dict.fromkeys((*old, *new)) if old.get(name) != new.get(name)]
    if changed:
        changes = ", ".join(f"{n} (was {old.get(n)}, now {new.get(n)})" for n in changed)
        raise RunError(
            f"{folder} is another search: {changes}; join it without these by --resume, or choose "
            "another --run-dir"
        )


def suggest_values(search: Search, trial: "optuna.Trial") -> dict[str, Any]:
    """Return the values of a trial by dotted name; empty for a preset outside the space.

    They depend on the seed of the preset, the number of the trial and the trials that have ended.
    """
    import numpy as np
    import optuna

    if trial.number == 0 and search.preset is None:
        return {}
    seed = np.random.SeedSequence([search.definition.config.seed, trial.number])
    # A preset without values would keep a joint model from any.
    joint = None if search.preset else False
    search.study.sampler = optuna.samplers.TPESampler(
        seed=int(seed.generate_state(1)[0]), multivariate=joint
    )
    values: dict[str, Any] = {}
    for name, part in search.space.items():
        if isinstance(part, Choices):
            values[name] = trial.suggest_categorical(name, part.texts)
        elif isinstance(part.low, int):
            values[name] = trial.suggest_int(name, part.low, int(part.high), log=part.log)
        else:
            values[name] = trial.suggest_float(name, part.low, part.high, log=part.log)
    return values
