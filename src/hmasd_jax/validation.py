"""Checks of settings that tell every mistake in one line."""

import difflib
import math
from collections.abc import Iterable
from typing import Any


class ConfigError(ValueError):
    """A setting is not usable; the message is one line naming field, value and remedy."""


def check_range(settings: Any, *names: str, low: float = -math.inf, high: float = math.inf) -> None:
    """Insist that the named fields are finite and in [low, high]; for use in `__post_init__`.

    Raises:
        ValueError: with a message that begins with the field's name.
    """
    for name in names:
        value = getattr(settings, name)
        if math.isfinite(value) and low <= value <= high:
            continue
        wanted = f"at least {low}" if math.isinf(high) else f"between {low} and {high}"
        wanted = wanted if math.isfinite(value) else "finite"
        raise ValueError(f"{name} must be {wanted}, got {value}")


def check_indices(settings: Any, name: str) -> None:
    """Insist that the named field holds different whole numbers from 0; for use in `__post_init__`.

    Raises:
        ValueError: with a message that begins with the field's name.
    """
    value = getattr(settings, name)
    if any(index < 0 for index in value) or len(set(value)) < len(value):
        raise ValueError(f"{name} must hold indices from 0, each once, got {list(value)}")


def check_multiple(name: str, value: int, of_name: str, of: int) -> None:
    """Insist that `value` is a whole multiple of `of`; for use in `__post_init__`.

    Raises:
        ValueError: with a message that begins with `name` and proposes the nearest multiples.
    """
    if value % of:
        down, up = value // of * of, (value // of + 1) * of
        near = f"{down} or {up}" if down else f"{up}"
        raise ValueError(f"{name} {value} is not a multiple of {of_name} {of}: try {near}")


def check_divides(name: str, value: int, of_name: str, of: int) -> None:
    """Insist that `value` divides `of`; for use in `__post_init__`.

    Raises:
        ValueError: with a message that begins with `name` and proposes the nearest divisor.
    """
    if of % value:
        near = min((d for d in range(1, of + 1) if of % d == 0), key=lambda d: abs(d - value))
        raise ValueError(f"{name} {value} does not divide {of_name} = {of}: try {near}")


def suggest(word: Any, known: Iterable[Any]) -> str:
    """A hint at the known word that was probably meant, or at all of them."""
    known = [str(k) for k in known]
    begins = [k for k in known if k.startswith(str(word))]
    close = begins or difflib.get_close_matches(str(word), known, n=1, cutoff=0.6)
    return f" (did you mean {close[0]}?)" if close else f" (known: {', '.join(known)})"
