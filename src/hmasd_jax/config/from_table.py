"""Build frozen dataclasses from plain values, and check their types.

The values come from TOML files, JSON files and command lines.
"""

import dataclasses
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from envs_jax.choices import show, suggest
from hmasd_jax.validation import ConfigError, parse_toml

T = TypeVar("T")
NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}
"""Names of types in messages."""


class Text(str):
    """A value typed on a command line; it is read as the type of its field."""

    __slots__ = ()


class Flag(Text):
    """An option typed without a value; it means true for a bool and is refused elsewhere."""

    __slots__ = ()


def from_table(cls: type[T], table: Any, path: str = "") -> T:
    """Build a dataclass from nested plain values.

    Args:
        cls: Dataclass to build; its fields may be dataclasses themselves.
        table: Values by field name. Missing fields keep their defaults.
        path: Dotted name of `table` for messages, e.g. `algorithm.ppo`.

    Raises:
        ConfigError: A key is unknown or missing, a value has another type, or `cls` refuses it.
    """
    if not isinstance(table, Mapping):
        raise ConfigError(f"{path} must be a table of settings, got {show(table)}")
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # pyrefly: ignore
    hints = get_type_hints(cls)
    for key in table:
        if key not in fields:
            inner = [_join(path, name) for name in list_names(cls, table) if "." in name]
            named = _join(path, show_name(key))
            raise ConfigError(f"unknown key {named}{suggest(key, fields, inner)}")
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


def list_names(cls: type, values: Mapping[str, Any] | None = None) -> list[str]:
    """Return the dotted names of the fields of a dataclass, those of inner ones included.

    The class of an inner one is that of its value, if `values` has it built, else the annotated.
    """
    kinds = get_type_hints(cls)
    kinds |= {n: type(v) for n, v in (values or {}).items() if dataclasses.is_dataclass(v)}
    names = []
    for name in (field.name for field in dataclasses.fields(cls) if field.init):
        inner = list_names(kinds[name]) if dataclasses.is_dataclass(kinds[name]) else []
        names += [name, *(f"{name}.{part}" for part in inner)]
    return names


def show_name(name: Any) -> str:
    """Return the name of a field as one short line for a message."""
    return name if str(name).isprintable() and len(name) < 80 else show(name)


def convert(value: Any, annotation: Any, path: str) -> Any:
    """Convert `value` to the type of a field.

    An int passes as a float, a whole float as an int, and a list as a tuple. A `Text` is parsed.

    Args:
        value: Plain value from a file or a command line.
        annotation: Type of the field.
        path: Dotted name of the field for messages.

    Raises:
        ConfigError: `value` has another type.
    """
    if annotation is Any or isinstance(annotation, TypeVar):
        return value
    if isinstance(value, Flag) and annotation is not bool:
        raise ConfigError(f"{path} needs a value")
    if dataclasses.is_dataclass(annotation):
        return from_table(annotation, value, path)
    origin, options = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return _convert_choice(value, options, path)
    if origin in (Union, types.UnionType):
        return _convert_union(value, options, path)
    if annotation is Path and isinstance(value, str):
        return Path(value)
    was_typed = isinstance(value, Text)
    value = _parse(value) if annotation is not str else value
    if origin is tuple and was_typed and not isinstance(value, list):
        value = [value]  # On a command line a list of one value is written as that value.
    if origin is tuple and isinstance(value, list | tuple):
        return _convert_items(value, options, path)
    if annotation is float and type(value) is int and abs(value) < 2**63:
        return float(value)
    if annotation is int and type(value) is float and value.is_integer():
        return int(value)
    if annotation is str and isinstance(value, str):
        return str(value)
    if type(value) is annotation:
        return value
    wanted = "a list such as [0, 1]" if origin is tuple else NAMES.get(annotation, annotation)
    raise ConfigError(f"{path} must be {wanted}, got {show(value)}")


def _convert_items(values: Sequence[Any], types: tuple, path: str) -> tuple:
    """Convert the items of a list to the types of a `tuple[X, ...]` or a `tuple[X, Y]`."""
    if types[-1] is Ellipsis:
        types = types[:1] * len(values)
    if len(values) != len(types):
        raise ConfigError(f"{path} must hold {len(types)} values, got {show(list(values))}")
    return tuple(convert(item, kind, path) for item, kind in zip(values, types))


def _convert_choice(value: Any, choices: tuple, path: str) -> Any:
    """Check `value` against the choices of a `Literal`."""
    value = str(value) if isinstance(value, Text) else value
    if value in choices:
        return value
    known = ", ".join(map(str, choices))
    raise ConfigError(f"{path} must be one of {known}; got {show(value)}{suggest(value, choices)}")


def _convert_union(value: Any, options: tuple, path: str) -> Any:
    """Convert `value` to the first type that accepts it.

    The word `none` stands for None, unless it may be a text or a path.
    """
    is_none = value is None or (str(value).lower() == "none" and not {str, Path} & {*options})
    if is_none and type(None) in options:
        return None
    options = tuple(option for option in options if option is not type(None))
    for option in options[:-1]:
        try:
            return convert(value, option, path)
        except ConfigError:
            continue
    return convert(value, options[-1], path)


def _parse(value: Any) -> Any:
    """Return the number, bool or list that a `Text` spells in TOML, else the text itself."""
    if not isinstance(value, Text):
        return value
    text = value.lower() if value.lower() in ("true", "false") else value
    try:
        # In a list of two, the text is one value: no comment, comma or further line can follow it.
        first, _ = parse_toml(f"value = [{text}, 0]".encode())["value"]
    except ValueError:
        return str(value)
    return first


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name
