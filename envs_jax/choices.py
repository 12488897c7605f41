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
        raise ValueError(f"{name} must be {' or '.join(map(str, allowed))}, got {show(value)}")


def check_whole(name: str, value: Any, low: int = 1, high: int = 2**31 - 1) -> None:
    """Check that a setting is an int of at least `low` and at most `high`.

    Raises:
        ValueError: `value` has another type or is out of range.
    """
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{name} must be a whole number, got {show(value)}")
    if value < low:
        raise ValueError(f"{name} must be at least {low}, got {show(value)}")
    if value > high:
        raise ValueError(f"{name} must be at most {high}, got {show(value)}")


def show(value: Any) -> str:
    """Return a value as one short line for a message."""
    try:
        text = repr(value)
    except ValueError:  # Python writes no int of more than 4300 digits.
        return "a number of many digits"
    except RecursionError:
        return "a value that is nested too deeply"
    return text if len(text) <= 80 else f"{text[:76]} ..."


def suggest(word: Any, known: Iterable[Any]) -> str:
    """Return a hint that ends an error message about an unknown word.

    Args:
        word: The word that is not known.
        known: All words that are.

    Returns:
        " (did you mean X?)" if `word` begins or resembles a known word X, else " (known: ...)".
    """
    known = [str(k) for k in known]
    word = str(word)[:200]  # Longer ones take long to compare and resemble nothing.
    begins = [k for k in known if k.startswith(word)]
    close = begins or difflib.get_close_matches(word, known, n=1, cutoff=0.6)
    return f" (did you mean {close[0]}?)" if close else f" (known: {', '.join(known) or 'none'})"
