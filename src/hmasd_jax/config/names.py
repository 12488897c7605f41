"""Find environments and algorithms by name, and their names by class."""

from collections.abc import Mapping
from typing import Any

from envs_jax.choices import show, suggest
from envs_jax.registry import ENVIRONMENTS
from hmasd_jax.algorithms import ALGORITHMS, AlgorithmEntry
from hmasd_jax.validation import ConfigError

REGISTER = "register your own with envs_jax.register(name, class)"
ADD = "add your own to hmasd_jax.algorithms.ALGORITHMS"
"""Remedies where environments and algorithms are not known."""


def find_env(name: Any) -> type:
    """Return the class of an environment.

    Raises:
        ConfigError: There is none of that name.
    """
    return _find(name, ENVIRONMENTS, "env.name", REGISTER)


def find_algorithm(name: Any) -> AlgorithmEntry:
    """Return an algorithm.

    Raises:
        ConfigError: There is none of that name, or another one has the same class of settings.
    """
    entry = _find(name, ALGORITHMS, "algorithm.name", ADD)
    name_of_algorithm(entry.config)
    return entry


def name_of_env(cls: type) -> str:
    """Return the name of an environment.

    Raises:
        ConfigError: Its class is not registered, or has several names.
    """
    return _name_of(cls, ENVIRONMENTS, REGISTER)


def name_of_algorithm(settings: type) -> str:
    """Return the name of the algorithm with this class of settings.

    Raises:
        ConfigError: There is none, or there are several.
    """
    return _name_of(settings, {name: entry.config for name, entry in ALGORITHMS.items()}, ADD)


def _find(name: Any, registry: Mapping[str, Any], path: str, remedy: str) -> Any:
    if isinstance(name, str) and name in registry:
        return registry[name]
    raise ConfigError(f"unknown {path} {show(name)}{suggest(name, registry, remedy=remedy)}")


def _name_of(cls: type, registry: Mapping[str, type], remedy: str) -> str:
    names = [name for name, registered in registry.items() if registered is cls]
    if not names:
        raise ConfigError(f"{cls.__name__} is not registered; {remedy}")
    if len(names) > 1:
        raise ConfigError(
            f"{cls.__name__} belongs to {' and '.join(names)}, so it names neither: give each a "
            "class of its own, such as a subclass"
        )
    return names[0]
