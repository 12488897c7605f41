"""Checks of the fields that take one of a few words."""

from typing import Any, get_args


def check_choice(name: str, value: Any, choices: Any) -> None:
    """Refuse a word that is none of `choices`.

    Args:
        name: of the field or argument, for the message.
        value: what it was given.
        choices: the `Literal` type that lists what it may be.

    Raises:
        ValueError: `value` is something else.
    """
    if value not in get_args(choices):
        raise ValueError(f"{name} must be {' or '.join(get_args(choices))}, got {value!r}")
