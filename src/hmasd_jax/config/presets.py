"""The preset that comes closest to a configuration, to tell what a run changed."""

import tomllib
from typing import Any

from hmasd_jax.config.train_config import ROOTS, from_json, identity, to_json

TASK = ("env.name", "env.scenario", "env.layout")
"""Settings that name a task."""


def find_preset(table: dict[str, Any]) -> tuple[str, dict[str, Any]] | None:
    """Return the paper's preset for a task and algorithm.

    Args:
        table: Resolved configuration of a run, of JSON types.

    Returns:
        Its name, e.g. `alice_and_bob/hmasd`, and its resolved configuration by dotted name; None
        if there is none for the task and algorithm.
    """
    wanted = identity(table)
    for folder in (root / "configs" for root in ROOTS):
        for path in sorted(folder.rglob(f"{table['algorithm']['name']}.toml")):
            preset = to_json(from_json(tomllib.loads(path.read_text())))
            found = identity(preset)
            if all(found.get(name) == wanted.get(name) for name in TASK):
                return str(path.relative_to(folder).with_suffix("")), found
    return None
