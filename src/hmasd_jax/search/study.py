"""A search in its folder and in Optuna's storage.

- `preset.json`: the configuration that the trials change.
- `study.json`: where Optuna's storage is.
- `journal.log`: that storage, unless it is a database.
- `trial_<n>/`: the run of trial n. Trial 0 is the preset itself.

What is searched stands in the storage, so that all processes agree on it.
"""

import json
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from envs_jax.optional import require
from hmasd_jax.config import (
    TrainConfig,
    from_json,
    identity,
    name_differences,
    read_table,
    to_json,
)
from hmasd_jax.runs.folder import LOCK, RunError, exclusive, write_json
from hmasd_jax.search.space import Choices, Space, preset_values, read_space
from hmasd_jax.search.storage import hide_password, open_storage

if TYPE_CHECKING:
    import optuna


class Definition(NamedTuple):
    """Definition of a search: its space, and the rules by which trials are judged."""

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
    given = {"storage": hide_password(storage), "name": name}
    wanted = {key: value for key, value in given.items() if value is not None}
    _check_unused(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with exclusive(folder / LOCK):
            if is_search(folder):
                place = _read_place(folder, wanted)
                return _open(folder, place, storage, definition, space, trials)
            place = given | {"name": name or folder.resolve().name, "place": uuid.uuid4().hex}
            search = _open(folder, place, storage, definition, space, trials)
            write_json(folder / "preset.json", to_json(definition.config))
            write_json(folder / "study.json", place)
            return search
    except OSError as error:
        raise RunError(f"cannot write {folder}: {error.strerror or error}") from error


def _check_unused(folder: Path) -> None:
    """Check that a folder is absent, empty or that of a search, maybe one that just begins.

    Raises:
        RunError: It is not.
    """
    begun = {"preset.json", "journal.log", "journal.log.lock"}
    others = {path.name for path in folder.glob("[!.]*")} - begun
    if others and not is_search(folder):
        raise RunError(f"{folder} is not empty, and not a search: choose another --run-dir")


def _read_place(folder: Path, wanted: dict[str, Any]) -> dict[str, Any]:
    """Read where the storage of a folder is.

    Args:
        folder: Folder of the search.
        wanted: Storage and name that were asked for, if any.

    Raises:
        RunError: Others were asked for.
    """
    place = read_table(folder / "study.json")
    for key, value in wanted.items():
        if place.get(key) != value:
            was = place.get(key) or "its journal.log"
            raise RunError(
                f"{folder} has the {key} {was}, not {value}: choose another --run-dir, or leave "
                "out --storage and --study-name"
            )
    return place


def _open(
    folder: Path,
    place: dict[str, Any],
    storage: str | None,
    definition: Definition,
    space: Space,
    trials: int,
) -> Search:
    """Open the study of a folder; what is missing in the storage is written."""
    import optuna

    with open_storage(folder, place, storage, may_write=True) as opened:
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
    place = _read_place(folder, {"storage": hide_password(storage)} if storage else {})
    with open_storage(folder, place, storage, may_write=False) as opened:
        study = optuna.load_study(study_name=place["name"], storage=opened)
        table = study.user_attrs["definition"]
    config = from_json(table["config"])
    settings = [(name, texts) for name, texts in table["settings"]]
    definition = Definition(config, settings, table["last"], table["prune_after"])
    space = read_space(config, settings)
    return Search(folder, definition, space, study, place["place"], place["storage"] is None)


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
        # Settings that this version has gained are at their defaults.
        return {"vary": vary, **judged, **lengths, **identity(to_json(from_json(config)))}

    old, new = flat(saved), flat(json.loads(json.dumps(wanted)))
    if changes := name_differences(old, new):
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
