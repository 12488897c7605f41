"""Environments by name."""

import dataclasses
from typing import Any

from envs_jax.adapters import JaxMARL
from envs_jax.alice_and_bob import AliceAndBob
from envs_jax.choices import suggest
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
    """Return the names that `make` accepts, sorted."""
    return sorted(ENVIRONMENTS)


def register(name: str, environment: type) -> None:
    """Add an environment to those that `make` can build.

    Args:
        name: Name to give to `make`.
        environment: Frozen dataclass that implements `Environment`.

    Raises:
        ValueError: `environment` is not a frozen dataclass, or another environment has this name.
    """
    params = getattr(environment, "__dataclass_params__", None)
    is_frozen = isinstance(environment, type) and params is not None and params.frozen
    if not is_frozen or environment.__hash__ is None:  # Algorithms are cached by it.
        raise ValueError(f"{name}: an environment must be a frozen dataclass, got {environment!r}")
    taken = ENVIRONMENTS.get(name, environment)
    if (taken.__module__, taken.__qualname__) != (environment.__module__, environment.__qualname__):
        raise ValueError(
            f"the name {name!r} is already taken by {taken.__qualname__}; choose another one"
        )
    ENVIRONMENTS[name] = environment  # A cell of a notebook defines its class anew when run again.


def make(name: str, **overrides: Any) -> Environment:
    """Build an environment by name.

    Args:
        name: One of `names()`.
        **overrides: Values for fields of the environment's dataclass. Other fields keep their
            defaults.

    Raises:
        ValueError: The name or a field is unknown, or the environment refuses a value.
    """
    if name not in ENVIRONMENTS:
        raise ValueError(f"unknown environment {name!r}{suggest(name, names())}")
    environment = ENVIRONMENTS[name]
    fields = [field.name for field in dataclasses.fields(environment) if field.init]
    for field in overrides:
        if field not in fields:
            raise ValueError(f"{name} has no field {field!r}{suggest(field, fields)}")
    try:
        return environment(**overrides)
    except TypeError as error:  # The environment compared or hashed a value of a wrong type.
        values = ", ".join(f"{field}={value!r}" for field, value in overrides.items())
        raise ValueError(
            f"{name} cannot be built with ({values}): {error}; check the types of these values"
        ) from error
