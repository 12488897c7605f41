"""Checks of environment settings, and hints for words that are not known."""

import difflib
from collections.abc import Iterable
from typing import Any, get_args


def check_choice(name: str, value: Any, choices: Any) -> None:
    """Check that a setting has one of the values that its type allows.

    Args:
        name: Name of the field or argument, for the message.
        value: Value that it was given.
        choices: `Literal` type that lists the allowed values.

    Raises:
        ValueError: `value` is none of them.
    """
    allowed = get_args(choices)
    if value not in allowed:
        raise ValueError(f"{name} must be {' or '.join(map(str, allowed))}, got {value!r}")


def check_whole(name: str, value: Any, low: int = 1) -> None:
    """Check that a setting is an int of at least `low`.

    Raises:
        ValueError: `value` has another type or is too small.
    """
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{name} must be a whole number, got {value!r}")
    if value < low:
        raise ValueError(f"{name} must be at least {low}, got {value}")


def suggest(word: Any, known: Iterable[Any]) -> str:
    """Return a hint that ends an error message about an unknown word.

    Args:
        word: The word that is not known.
        known: All words that are.

    Returns:
        " (did you mean X?)" if `word` begins or resembles a known word X, else " (known: ...)".
    """
    known = [str(k) for k in known]
    begins = [k for k in known if k.startswith(str(word))]
    close = begins or difflib.get_close_matches(str(word), known, n=1, cutoff=0.6)
    return f" (did you mean {close[0]}?)" if close else f" (known: {', '.join(known) or 'none'})"
