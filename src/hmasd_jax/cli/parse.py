"""Parse command lines into the options of a command and overrides of the configuration.

tyro writes the help (see `help`) but does not parse. It takes a bool either as `--x` or as
`--x True`, but recorded commands write `--x true`. It refuses `3e6` for a whole number, and its
error messages take several lines. Values are converted by `from_table`, as in TOML files, so that a
setting means the same in a file and on a command line.
"""

import dataclasses
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from tyro.conf import Positional

from envs_jax.choices import suggest
from hmasd_jax.cli.options import Options, RunOptions
from hmasd_jax.config import RENAMED, ConfigError, TrainConfig, load
from hmasd_jax.config.from_table import Flag, Text, from_table, list_names, show_name
from hmasd_jax.runs.folder import read_config

TRUTH = ("true", "false")
"""Words that may follow a flag of a command, which is true without them."""

OptionsT = TypeVar("OptionsT", bound=Options)


def parse(cls: type[OptionsT], words: Sequence[str]) -> tuple[OptionsT, dict[str, Text]]:
    """Split a command line into options and overrides.

    Args:
        cls: Options of the command. Only `RunOptions` come with overrides.
        words: Words after the command's name.

    Returns:
        The options, and all other `--name value` pairs by dotted name, for `config.load`.

    Raises:
        ConfigError: A word is unexpected, an option is unknown, or its value has a wrong type.
    """
    types = get_type_hints(cls)
    own = {field.name: types[field.name] for field in dataclasses.fields(cls)}
    positional = _positional(cls)
    given: dict[str, Any] = {}
    overrides: dict[str, Text] = {}
    rest = deque(words)
    while rest:
        word = rest.popleft()
        if not word.startswith("--"):
            _add_positional(given, positional, own, word)
            continue
        name, equals, value = word[2:].partition("=")
        name = name.replace("-", "_")
        name = cls.OLD_NAMES.get(name, name)
        if name not in own and not issubclass(cls, RunOptions):
            raise ConfigError(f"unknown option --{name}{suggest(name, own)}")
        value = Text(value) if equals else _take_value(rest, own.get(name))
        if name not in own:
            overrides[name] = value
        elif own[name] == tuple[str, ...]:  # It may be repeated.
            given[name] = (*given.get(name, ()), value)
        else:
            given[name] = value
    return from_table(cls, given), overrides


def _positional(cls: type[Options]) -> str | None:
    """Return the field that takes words without a name."""
    hints = get_type_hints(cls, include_extras=True).items()
    names = [name for name, hint in hints if Positional in getattr(hint, "__metadata__", ())]
    return names[0] if names else None


def _add_positional(
    given: dict[str, Any], positional: str | None, own: dict[str, Any], word: str
) -> None:
    """Put a word without a name into `given`."""
    if positional is None:
        raise ConfigError(f"unexpected {word!r}: settings are written --name value")
    if own[positional] == tuple[Path, ...]:
        given[positional] = (*given.get(positional, ()), Text(word))
    elif positional in given:
        raise ConfigError(f"unexpected {word!r}: {given[positional]} is given already")
    else:
        given[positional] = Text(word)


def _take_value(rest: deque[str], option: Any) -> Text:
    """Take the value of a name from the words after it.

    Args:
        rest: Words after the name; those of the value are removed.
        option: Type of the command's option, None for a setting. A setting takes all words up to
            the next name: several make a list.
    """
    if not rest or rest[0].startswith("--") or (option is bool and rest[0].lower() not in TRUTH):
        return Flag("true")
    values = [rest.popleft()]
    while option is None and rest and not rest[0].startswith("--"):
        values.append(rest.popleft())
    return Text(values[0] if len(values) == 1 else f"[{', '.join(values)}]")


def load_config(options: RunOptions, overrides: dict[str, Text]) -> TrainConfig:
    """Read the configuration that a command line asks for.

    Raises:
        ConfigError: It cannot be read, an option is unknown, or `--resume` comes without a folder.
        RunError: `--resume` does not name a run.
    """
    if options.resume and options.run_dir is None:
        raise ConfigError("--resume needs --run-dir, the folder of the run to continue")
    settings = list_names(TrainConfig)
    known = {n: value for n, value in overrides.items() if "." in n or n in {*settings, *RENAMED}}
    if options.resumed_run is not None and options.config is None:
        config = read_config(options.resumed_run, known)
    else:
        config = load(options.base, known)
    if unknown := [name for name in overrides if name not in known]:
        names = [field.name for field in dataclasses.fields(options)] + settings
        inner = [name for name in list_names(TrainConfig, vars(config)) if "." in name]
        hint = suggest(unknown[0], names, inner)
        raise ConfigError(f"unknown option --{show_name(unknown[0])}{hint}")
    return config


def drop_options(words: Sequence[str], *names: str) -> list[str]:
    """Return the words of a command line without the named options and their values."""
    kept: list[str] = []
    dropping = False
    for word in words:
        if word.startswith("--"):
            dropping = word[2:].partition("=")[0].replace("_", "-") in names
        if not dropping:
            kept.append(word)
    return kept
