"""Frozen dataclasses from tables of plain values: TOML files, JSON files and command lines."""

import dataclasses
import tomllib
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from hmasd_jax.validation import ConfigError, suggest

T = TypeVar("T")
NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}


class Text(str):
    """A value as typed on a command line: read as whatever type its field has."""

    __slots__ = ()


class Flag(Text):
    """A name typed without a value: true, where that is possible."""

    __slots__ = ()


def from_table(cls: type[T], table: Any, path: str = "") -> T:
    """Build dataclass `cls` from nested plain values.

    Args:
        cls: a dataclass; fields may be dataclasses themselves.
        table: values by field name; what is not given keeps its default.
        path: where `table` stands, for messages, e.g. `algorithm.ppo`.

    Raises:
        ConfigError: unknown key, wrong type, or a value that `cls` refuses.
    """
    if not isinstance(table, Mapping):
        raise ConfigError(f"{path} must be a table of settings, got {table!r}")
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # pyrefly: ignore
    hints = get_type_hints(cls)
    for key in table:
        if key not in fields:
            raise ConfigError(f"unknown key {_join(path, key)}{suggest(key, fields)}")
    for name, field in fields.items():
        required = field.default is field.default_factory is dataclasses.MISSING
        if required and name not in table:
            raise ConfigError(f"{_join(path, name)} is missing: it has no default")
    values = {key: convert(value, hints[key], _join(path, key)) for key, value in table.items()}
    try:
        return cls(**values)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(_join(path, str(error))) from error


def convert(value: Any, annotation: Any, path: str) -> Any:
    """Check `value` against a field's type; whole floats pass as int, lists as tuples.

    Raises:
        ConfigError: `value` is of another type.
    """
    if annotation is Any or isinstance(annotation, TypeVar):
        return value
    if isinstance(value, Flag) and annotation is not bool:
        raise ConfigError(f"{path} needs a value")
    if dataclasses.is_dataclass(annotation):
        return from_table(annotation, value, path)
    origin, options = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        plain = str(value) if isinstance(value, Text) else value
        if plain not in options:
            known = ", ".join(map(str, options))
            raise ConfigError(
                f"{path} must be one of {known}; got {plain!r}{suggest(plain, options)}"
            )
        return plain
    if origin in (Union, types.UnionType):
        return _convert_union(value, options, path)
    if annotation is Path and isinstance(value, str):
        return Path(value)
    was_typed = isinstance(value, Text)
    value = _parse(value) if annotation is not str else value
    if origin is tuple and was_typed and not isinstance(value, list):
        value = [value]  # On a command line a list of one is written as that one.
    if origin is tuple and isinstance(value, list | tuple):
        return tuple(convert(item, options[0], path) for item in value)
    if annotation is float and type(value) is int:
        return float(value)
    if annotation is int and type(value) is float and value.is_integer():
        return int(value)
    if annotation is str and isinstance(value, str):
        return str(value)
    if type(value) is annotation:
        return value
    wanted = "a list such as [0, 1]" if origin is tuple else NAMES.get(annotation, annotation)
    raise ConfigError(f"{path} must be {wanted}, got {value!r}")


def _convert_union(value: Any, options: tuple, path: str) -> Any:
    """The first type that takes `value`; `none` is written for None."""
    if (value is None or str(value).lower() == "none") and type(None) in options:
        return None
    options = tuple(option for option in options if option is not type(None))
    for option in options[:-1]:
        try:
            return convert(value, option, path)
        except ConfigError:
            continue
    return convert(value, options[-1], path)


def _parse(value: Any) -> Any:
    """The number, truth value or list that a `Text` spells, else the text."""
    if not isinstance(value, Text):
        return value
    text = value.lower() if value.lower() in ("true", "false") else value
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return str(value)


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name
