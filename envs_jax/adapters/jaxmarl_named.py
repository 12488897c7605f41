"""JaxMARL's environments by name, so that a command line or a file can ask for one."""

import difflib
import tomllib
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

from envs_jax.adapters.jaxmarl_import import JaxMARLTask
from envs_jax.optional import require


@dataclass(frozen=True, kw_only=True)
class JaxMARL(JaxMARLTask):
    """A cooperative environment of JaxMARL; `jaxmarl_import` tells how it is made one of ours.

    Raises:
        MissingPackageError: jaxmarl is not installed.
        ValueError: a field names what JaxMARL does not have, or what has no cooperating agents
            with discrete actions.
    """

    id: str = "overcooked"
    """JaxMARL's name of the environment, e.g. overcooked, HeuristicEnemySMAX or
    MPE_simple_spread_v3."""
    options: str = ""
    """What its constructor is given, e.g. "scenario=3m, walls_cause_death=false". Layouts of
    Overcooked and scenarios of SMAX are written by name."""

    label: ClassVar[str] = "id"

    @property
    def source(self) -> Any:
        """The environment of JaxMARL."""
        return _make(self.id, self.options)


@lru_cache(maxsize=64)
def _make(name: str, options: str) -> Any:
    """The same object for the same words, as JaxMARL compiles anew for every object."""
    jaxmarl = require("jaxmarl", "compare", f"id {name}")
    known = jaxmarl.registered_envs
    if name not in known:
        raise ValueError(f"id: JaxMARL has no environment {name!r}{_suggest(name, known)}")
    values = {word: _look_up(name, word, value) for word, value in _parse(options).items()}
    try:
        with warnings.catch_warnings():
            # Overcooked recommends its successor at every start.
            warnings.simplefilter("ignore", DeprecationWarning)
            return jaxmarl.make(name, **values)
    except (TypeError, AssertionError, NotImplementedError, ImportError) as error:
        given = f"options {options!r}: {name}" if options else f"id: {name}"
        raise ValueError(f"{given} cannot be made: {error}") from error


def _parse(options: str) -> dict[str, Any]:
    """The values that "a=1, b=text" spells; numbers and truth values as in TOML.

    Raises:
        ValueError: a part is not of the form name=value.
    """
    values: dict[str, Any] = {}
    for part in filter(None, (part.strip() for part in options.split(","))):
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
    """The object behind the name of a layout or a scenario; other values as they are."""
    if (env, option) == ("overcooked", "layout"):
        from jaxmarl.environments import overcooked

        table = overcooked.overcooked_layouts
    elif option == "scenario":
        from jaxmarl.environments.smax import smax_env

        table = smax_env.MAP_NAME_TO_SCENARIO
    else:
        return value
    if value not in table:
        raise ValueError(f"options: {env} has no {option} {value!r}{_suggest(value, table)}")
    return table[value]


def _suggest(word: Any, known: Iterable[str]) -> str:
    """A hint at the known word that was probably meant, or at all of them."""
    known = list(known)
    close = difflib.get_close_matches(str(word), known, n=1)
    return f" (did you mean {close[0]}?)" if close else f" (known: {', '.join(known)})"
