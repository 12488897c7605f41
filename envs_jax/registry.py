"""Environments by name."""

from typing import Any

from envs_jax.alice_and_bob import AliceAndBob
from envs_jax.types import Environment

ENVIRONMENTS: dict[str, type] = {
    "alice_and_bob": AliceAndBob,
}


def names() -> list[str]:
    """Names that `make` knows."""
    return sorted(ENVIRONMENTS)


def make(name: str, **overrides: Any) -> Environment:
    """Build the environment called `name`, with fields of its dataclass overridden.

    Raises:
        ValueError: unknown name, unknown field or a value the environment refuses.
    """
    raise NotImplementedError
