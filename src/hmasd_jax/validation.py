"""Checks of settings and files whose messages are one line that names the fault and the remedy."""

import json
import math
import re
import tomllib
import types
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

LARGEST = 2**31 - 1
"""Largest count, since counters and indices of arrays have 32 bits."""
LARGEST_FLOAT = 3.4e38
"""Largest number, since arrays have 32 bits."""
SMALLEST = 1e-12
"""Least value of what is added to a divisor, or a gradient clipped to. With 0, a zero gives NaN."""
SLOWEST_FPS, FASTEST_FPS = 0.1, 100
"""Frames per second that an animation can have: a GIF counts in hundredths of a second."""


class ConfigError(ValueError):
    """A setting that cannot be used; the message is one line naming field, value and remedy."""


def check_range(
    settings: Any, *names: str, low: float = -math.inf, high: float | None = None
) -> None:
    """Check that fields are finite and in [low, high]; for use in `__post_init__`.

    Args:
        settings: Object with the fields.
        *names: Names of the fields.
        low: Smallest value.
        high: Largest value. By default, what 32 bits hold: `LARGEST` for an int, and
            `LARGEST_FLOAT` for a float.

    Raises:
        ValueError: A field is not finite or out of range; the message begins with its name.
    """
    for name in names:
        value = getattr(settings, name)
        limit = LARGEST_FLOAT if isinstance(value, float) else LARGEST
        limit = limit if high is None else high
        if low <= value <= limit:
            continue
        if isinstance(value, float) and not math.isfinite(value):
            wanted = "finite"
        elif high is not None:
            wanted = f"between {low} and {high}"
        else:
            wanted = f"at most {limit}" if value > limit else f"at least {low}"
        raise ValueError(f"{name} must be {wanted}, got {_show(value)}")


def check_types(settings: Any) -> None:
    """Check that fields have the types that they are annotated with; for use in `__post_init__`.

    Files and command lines are converted before. This finds the mistakes of Python code.

    Raises:
        ValueError: A field has another type; the message begins with its name.
    """
    for name, kind in get_type_hints(type(settings)).items():
        value = getattr(settings, name)
        if not _is_a(value, kind):
            if get_origin(kind) is Literal:
                wanted = " or ".join(map(str, get_args(kind)))
            else:
                wanted = kind.__name__ if isinstance(kind, type) else str(kind)
            raise ValueError(f"{name} must be {wanted}, got {_show(value)}")


def _is_a(value: Any, kind: Any) -> bool:
    """Return whether a value has an annotated type. An int is a float, and a bool is no number."""
    origin, options = get_origin(kind), get_args(kind)
    if origin is Literal:
        return value in options
    if origin in (Union, types.UnionType):
        return any(_is_a(value, option) for option in options)
    if origin is tuple:
        return isinstance(value, tuple) and all(_is_a(item, options[0]) for item in value)
    if kind in (int, float):
        return isinstance(value, (int, kind)) and not isinstance(value, bool)
    return isinstance(value, kind) if isinstance(kind, type) else True


def _show(value: Any) -> str:
    from envs_jax.choices import show  # It imports JAX, which correct options do not wait for.

    return show(value)


def check_indices(settings: Any, name: str) -> None:
    """Check that a field holds distinct whole numbers from 0; for use in `__post_init__`.

    Raises:
        ValueError: It holds others; the message begins with the field's name.
    """
    value = getattr(settings, name)
    if any(index < 0 for index in value) or len(set(value)) < len(value):
        raise ValueError(f"{name} must hold indices from 0, each once, got {_show(list(value))}")


def check_multiple(name: str, value: int, of_name: str, of: int) -> None:
    """Check that `value` is a multiple of `of`; for use in `__post_init__`.

    Raises:
        ValueError: It is not; the message begins with `name` and proposes the nearest multiples.
    """
    if value % of:
        down, up = value // of * of, (value // of + 1) * of
        near = f"{down} or {up}" if down else f"{up}"
        raise ValueError(f"{name} {value} is not a multiple of {of_name} {of}: try {near}")


def check_divides(name: str, value: int, of_name: str, of: int) -> None:
    """Check that `value` divides `of`; for use in `__post_init__`.

    Raises:
        ValueError: It does not; the message begins with `name` and proposes a divisor near it.
    """
    if of % value:
        window = range(max(1, value - 1000), min(of, value + 1000) + 1)
        divisors = (d for d in window if of % d == 0)
        near = min(divisors, key=lambda d: abs(d - value), default=math.gcd(value, of))
        raise ValueError(f"{name} {value} does not divide {of_name} = {of}: try {near}")


def parse_json(data: bytes) -> Any:
    """Read JSON from bytes, as strictly as its standard has it.

    Raises:
        ValueError: It is not JSON in UTF-8, a key occurs twice in one object, a number is not
            finite, or it is nested too deeply. The message is one line.
    """
    try:
        return json.loads(data.decode(), object_pairs_hook=_table, parse_constant=_refuse)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def _table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the object of these keys and values."""
    table = dict(pairs)
    if len(table) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice!r} occurs twice")
    return table


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not a number of JSON")


def parse_toml(data: bytes) -> dict[str, Any]:
    """Read TOML from bytes.

    Raises:
        ValueError: It is not valid, or nested too deeply. The message is one line.
    """
    try:
        return tomllib.loads(data.decode())
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def parse_index(text: str) -> int | None:
    """Return the whole number from 0 that a name spells as `str` does, or None if it does not."""
    return int(text) if re.fullmatch("0|[1-9][0-9]{0,18}", text, re.ASCII) else None
