"""Commands that records name still parse, and their files are still there."""

import json
import re
import shlex
from collections.abc import Iterator
from typing import Any

import pytest

from hmasd_jax.cli.main import COMMANDS
from hmasd_jax.cli.options import RunOptions
from hmasd_jax.cli.parse import load_config, parse
from scripts.records import RESULTS, ROOT

TRAIN = ("python", "-m", "hmasd_jax.train")


def commands_in(value: Any) -> Iterator[tuple[str, ...]]:
    """Yield the words of all commands in a record."""
    if isinstance(value, dict):
        command = value.get("command")
        if isinstance(command, str):
            yield tuple(shlex.split(command))
        elif command:
            yield tuple(command)
    if isinstance(value, dict | list):
        for child in value.values() if isinstance(value, dict) else value:
            yield from commands_in(child)


@pytest.fixture(scope="module")
def commands():
    """Recorded commands by record. Records of one seed per command write `I` for its index."""
    found = {}
    for path in sorted(RESULTS.rglob("*.json")):
        words = list(commands_in(json.loads(path.read_text())))
        single = [" ".join(command).partition(" for I = ")[0] for command in words]
        found[path] = {tuple(re.sub(r" I\b", " 0", command).split()) for command in single}
    assert sum(map(len, found.values())) > 500
    return found


def test_the_scripts_and_presets_of_recorded_commands_are_there(commands):
    words = {word for of_file in commands.values() for command in of_file for word in command}
    named = {word for word in words if re.fullmatch(r"(?!runs/)[\w/]+\.(py|toml)", word)}
    assert "configs/alice_and_bob/hmasd_robust.toml" in named
    assert not [name for name in sorted(named) if not (ROOT / name).exists()]


def test_recorded_commands_of_the_trainer_parse(commands, monkeypatch):
    """Those in `tried/` may have settings that were tried and dropped."""
    monkeypatch.chdir(ROOT)
    names = []
    for path, of_file in commands.items():
        for words in () if "tried" in path.parts else of_file:
            if words[:3] == TRAIN:
                names.append(words[3])
                options, overrides = parse(COMMANDS[words[3]].options, words[4:])
                if isinstance(options, RunOptions) and options.resumed_run is None:
                    load_config(options, overrides)
    assert len(names) > 30
    assert set(names) >= {"train", "seed_sweep"}
