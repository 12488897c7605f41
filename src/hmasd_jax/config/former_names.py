"""Former names of settings, which files of earlier versions have and which are still read."""

from collections.abc import Mapping
from typing import Any

from hmasd_jax.validation import ConfigError

RENAMED = {"layout": "placement"}
"""Former names of settings of `TrainConfig`, with the names they have now."""
SOLVED = {
    "hmasd": {
        "solved_gain": "skill_gain",
        "solved_entropy_coef": "high_entropy_coef",
        "solved_low_entropy_coef": "low_entropy_coef",
        "solved_random_share": "random_share",
        "solved_balance": "balance",
        "solved_step_factor": "coordinator_step_factor",
        "solved_low_step_factor": "step_factor",
        "sharpening": "sharpening",
    },
    "mappo": {"solved_step_factor": "step_factor", "sharpening": "sharpening"},
    "ippo": {"solved_step_factor": "step_factor", "sharpening": "sharpening"},
}
"""Former names of settings of each algorithm, with the names they have in `algorithm.solved`."""


def rename(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings, from a file or by dotted name, with the names that they have now.

    Raises:
        ConfigError: A setting is given by its former name and by the new one.
    """
    for old, new in RENAMED.items():
        _refuse_both(settings, old, settings, new)
    settings = {RENAMED.get(name, name): value for name, value in settings.items()}
    if isinstance(settings.get("algorithm"), Mapping):
        settings["algorithm"] = _group_solved(settings["algorithm"])
    return settings


def _group_solved(algorithm: Mapping[str, Any]) -> Mapping[str, Any]:
    """Move the settings of solved tasks into their table."""
    name = algorithm.get("name", "hmasd")
    former = SOLVED.get(name, {}) if isinstance(name, str) else {}
    solved = algorithm.get("solved", {})
    if not former.keys() & algorithm or not isinstance(solved, Mapping):
        return algorithm
    for old, new in former.items():
        _refuse_both(algorithm, old, solved, new, "algorithm.", "algorithm.solved.")
    moved = {new: algorithm[old] for old, new in former.items() if old in algorithm}
    rest = {name: value for name, value in algorithm.items() if name not in former}
    return rest | {"solved": {**solved, **moved}}


def _refuse_both(
    olds: Mapping[str, Any], old: str, news: Mapping[str, Any], new: str, *tables: str
) -> None:
    """Refuse a setting that has its former and its new name."""
    at_old, at_new = tables or ("", "")
    if old in olds and new in news:
        raise ConfigError(
            f"{at_old}{old} is the former name of {at_new}{new}: give only {at_new}{new}"
        )
