"""Environments of JaxMARL by name, for command lines and configuration files."""

import inspect
import tomllib
import warnings
from collections.abc import Iterable
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
            env = jaxmarl.make(name, **values)
    except (TypeError, AssertionError, NotImplementedError, ImportError) as error:
        given = f"options {options!r}: {name}" if options else f"id: {name}"
        raise ValueError(f"{given} cannot be built: {error}") from error
    check_options(name, env, values)
    return env


def check_options(name: str, env: Any, values: Iterable[str]) -> None:
    """Check that an environment of JaxMARL has used all options; some ignore what they do not know.

    Args:
        name: JaxMARL's name of the environment.
        env: The environment, built with the options.
        values: Names of the options.

    Raises:
        ValueError: No constructor names an option, and the environment has no such property.
    """
    known, objects = _named_by_constructors(env), (env, getattr(env, "_env", None))
    for option in values:
        if option not in known and not any(hasattr(x, option) for x in objects):
            raise ValueError(f"options: {name} has no option {option!r}{suggest(option, known)}")


def _named_by_constructors(env: Any) -> set[str]:
    """Return the arguments of an environment, of those it inherits from and of the one it wraps."""
    names: set[str] = set()
    for cls in type(env).__mro__:
        if "__init__" in vars(cls):
            parameters = [*inspect.signature(cls.__init__).parameters.values()][1:]
            names |= {p.name for p in parameters if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)}
            if not any(p.kind is p.VAR_KEYWORD for p in parameters):
                break  # It takes nothing from the classes below it.
    wrapped = getattr(env, "_env", None)
    return names | (_named_by_constructors(wrapped) if wrapped is not None else set())


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
