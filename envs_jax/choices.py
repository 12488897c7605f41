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


def suggest(word: Any, known: Iterable[Any], inner: Iterable[str] = (), remedy: str = "") -> str:
    """Return a hint that ends an error message about an unknown word.

    Args:
        word: The word that is not known.
        known: All words that are.
        inner: Dotted names that are known, too, and are found by their last part.
        remedy: What to do where no known word is meant.

    Returns:
        " (did you mean X?)" if a known word X is near to `word`, else " (known: ...)" and the
        remedy.
    """
    known = [str(k) for k in known]
    names = {name: [name] for name in known}
    for name in inner:
        names.setdefault(name.rpartition(".")[2], []).append(name)
    near = find_near(str(word)[:200], names)  # Longer ones take long to compare.
    if near is None:
        return f" (known: {', '.join(known) or 'none'})" + (f"; {remedy}" if remedy else "")
    return f" (did you mean {' or '.join(names[near])}?)"


def find_near(word: str, known: Iterable[str]) -> str | None:
    """Return the known word that is meant by another; None if none is near to it.

    A word is the known one itself, its beginning, one of its parts (`seeds` for `num_seeds`), its
    initials (`lr` for `learning_rate`), or like it.
    """
    known = list(known)
    for is_near in (
        lambda name: name == word,
        lambda name: name.startswith(word),
        lambda name: word in name.split("_") or word == "".join(p[:1] for p in name.split("_")),
    ):
        if near := next(filter(is_near, known), None):
            return near
    return next(iter(difflib.get_close_matches(word, known, n=1, cutoff=0.6)), None)
