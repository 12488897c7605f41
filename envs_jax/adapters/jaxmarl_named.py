"""Environments of JaxMARL by name, for command lines and configuration files."""

import tomllib
import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

from envs_jax.adapters.jaxmarl_import import JaxMARLTask
from envs_jax.choices import suggest
from envs_jax.optional import require


@dataclass(frozen=True, kw_only=True)
class JaxMARL(JaxMARLTask):
    """Cooperative environment of JaxMARL, converted as `jaxmarl_import` describes.

    Raises:
        MissingPackageError: The package jaxmarl is not installed.
        ValueError: A field names something that JaxMARL does not have, or an environment without
            cooperating agents or discrete actions.
    """

    id: str = "overcooked"
    """JaxMARL's name of the environment, e.g. overcooked, HeuristicEnemySMAX or
    MPE_simple_spread_v3."""
    options: str = ""
    """Arguments of its constructor, e.g. "scenario=3m, walls_cause_death=false". Give layouts of
    Overcooked and scenarios of SMAX by name."""

    label: ClassVar[str] = "id"

    @property
    def source(self) -> Any:
        """The environment of JaxMARL."""
        return _make(self.id, self.options)


@lru_cache(maxsize=64)
def _make(name: str, options: str) -> Any:
    """Build an environment of JaxMARL.

    Equal arguments return the same object, because JaxMARL compiles for each object separately.
    """
    jaxmarl = require("jaxmarl", "compare", f"id {name}")
    known = jaxmarl.registered_envs
    if name not in known:
        raise ValueError(f"id: JaxMARL has no environment {name!r}{suggest(name, known)}")
    values = {word: _look_up(name, word, value) for word, value in _parse(options).items()}
    try:
        with warnings.catch_warnings():
            # Overcooked recommends its successor whenever it is built.
            warnings.simplefilter("ignore", DeprecationWarning)
            return jaxmarl.make(name, **values)
    except (TypeError, AssertionError, NotImplementedError, ImportError) as error:
        given = f"options {options!r}: {name}" if options else f"id: {name}"
        raise ValueError(f"{given} cannot be built: {error}") from error


def _parse(options: str) -> dict[str, Any]:
    """Parse options such as "a=1, b=text", with numbers and booleans as in TOML.

    Raises:
        ValueError: A part is not of the form name=value.
    """
    values: dict[str, Any] = {}
    for part in filter(None, (part.strip() for part in str(options).split(","))):
        name, equals, text = (word.strip() for word in part.partition("="))
        if not (name and equals and text):
            raise ValueError(
                f'options must be written "name=value, name=value", got {part!r} in {options!r}'
            )
        try:
            values[name] = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            values[name] = text
    return values


def _look_up(env: str, option: str, value: Any) -> Any:
    """Return the object that a layout or scenario name stands for, and other values unchanged."""
    if (env, option) == ("overcooked", "layout"):
        from jaxmarl.environments import overcooked

        table = overcooked.overcooked_layouts
    elif option == "scenario":
        from jaxmarl.environments.smax import smax_env

        table = smax_env.MAP_NAME_TO_SCENARIO
    else:
        return value
    if value not in table:
        raise ValueError(f"options: {env} has no {option} {value!r}{suggest(value, table)}")
    return table[value]
