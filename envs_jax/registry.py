"""Environments by name."""

import dataclasses
import difflib
from collections.abc import Iterable
from typing import Any, Literal, get_args, get_origin, get_type_hints

from envs_jax.adapters import JaxMARL
from envs_jax.alice_and_bob import AliceAndBob
from envs_jax.micro_battle.environment import MicroBattle
from envs_jax.overcooked.environment import Overcooked
from envs_jax.probes import PROBES
from envs_jax.types import Environment

ENVIRONMENTS: dict[str, type] = {
    "alice_and_bob": AliceAndBob,
    "overcooked": Overcooked,
    "micro_battle": MicroBattle,
    **PROBES,
    "jaxmarl": JaxMARL,
}


def names() -> list[str]:
    """Names that `make` knows."""
    return sorted(ENVIRONMENTS)


def register(name: str, environment: type) -> None:
    """Make `environment`, a frozen dataclass, known to `make` as `name`.

    Raises:
        ValueError: not a dataclass, or another environment has that name.
    """
    if not (isinstance(environment, type) and dataclasses.is_dataclass(environment)):
        raise ValueError(f"{name}: an environment is a frozen dataclass, got {environment!r}")
    if ENVIRONMENTS.setdefault(name, environment) is not environment:
        taken = ENVIRONMENTS[name].__qualname__
        raise ValueError(f"{name!r} is the name of {taken} already; choose another")


def make(name: str, **overrides: Any) -> Environment:
    """Build the environment called `name`, with fields of its dataclass overridden.

    Raises:
        ValueError: unknown name, unknown field or a value the environment refuses.
    """
    if name not in ENVIRONMENTS:
        raise ValueError(f"unknown environment {name!r}; {_remedy(name, names())}")
    environment = ENVIRONMENTS[name]
    types = get_type_hints(environment)
    fields = [field.name for field in dataclasses.fields(environment)]
    for field, value in overrides.items():
        if field not in fields:
            raise ValueError(f"{name} has no field {field!r}; {_remedy(field, fields)}")
        _check_value(f"{name}: {field}", types[field], value)
    return environment(**overrides)


def _check_value(where: str, expected: Any, value: Any) -> None:
    """Refuse a value of the wrong type; annotations other than plain types are not looked at."""
    if get_origin(expected) is Literal:
        if value not in get_args(expected):
            raise ValueError(f"{where} cannot be {value!r}; {_remedy(value, get_args(expected))}")
    elif isinstance(expected, type) and get_origin(expected) is None:
        accepted = (int, float) if expected is float else expected
        is_number_by_accident = isinstance(value, bool) and expected is not bool
        if is_number_by_accident or not isinstance(value, accepted):
            raise ValueError(f"{where} must be of type {expected.__name__}, got {value!r}")


def _remedy(given: Any, known: Iterable[Any]) -> str:
    """What to write instead: the closest known word, or all of them."""
    known = [str(word) for word in known]
    close = difflib.get_close_matches(str(given), known, n=1)
    if close:
        return f"did you mean {close[0]!r}?"
    return f"choose from {', '.join(known)}" if known else "there are none to set"
