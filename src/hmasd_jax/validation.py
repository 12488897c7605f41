"""Checks of settings whose messages are one line that names field, value and remedy."""

import math
from typing import Any


class ConfigError(ValueError):
    """A setting that cannot be used; the message is one line naming field, value and remedy."""


def check_range(settings: Any, *names: str, low: float = -math.inf, high: float = math.inf) -> None:
    """Check that fields are finite and in [low, high]; for use in `__post_init__`.

    Raises:
        ValueError: A field is not; the message begins with its name.
    """
    for name in names:
        value = getattr(settings, name)
        if math.isfinite(value) and low <= value <= high:
            continue
        wanted = f"at least {low}" if math.isinf(high) else f"between {low} and {high}"
        wanted = wanted if math.isfinite(value) else "finite"
        raise ValueError(f"{name} must be {wanted}, got {value}")


def check_indices(settings: Any, name: str) -> None:
    """Check that a field holds distinct whole numbers from 0; for use in `__post_init__`.

    Raises:
        ValueError: It does not; the message begins with the field's name.
    """
    value = getattr(settings, name)
    if any(index < 0 for index in value) or len(set(value)) < len(value):
        raise ValueError(f"{name} must hold indices from 0, each once, got {list(value)}")


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
        ValueError: It does not; the message begins with `name` and proposes the nearest divisor.
    """
    if of % value:
        near = min((d for d in range(1, of + 1) if of % d == 0), key=lambda d: abs(d - value))
        raise ValueError(f"{name} {value} does not divide {of_name} = {of}: try {near}")
