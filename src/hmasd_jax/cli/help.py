"""Help of a command, which tyro writes from types and docstrings."""

import contextlib
import dataclasses
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from hmasd_jax.cli.options import Options
from hmasd_jax.cli.wrap import fill, unbreak

if TYPE_CHECKING:  # It imports JAX, which commands without settings do not wait for.
    from hmasd_jax.config import TrainConfig


def write_help(
    command: str, summary: str, cls: type[Options], config: "TrainConfig | None" = None
) -> None:
    """Print the help of a command.

    Args:
        command: Name of the command.
        summary: Sentences that describe it.
        cls: Its options.
        config: Settings to list with their values, for commands that take settings.
    """
    no_prefix = tyro.conf.arg(name="")
    fields: list[Any] = [("options", Annotated[tyro.conf.FlagCreatePairsOff[cls], no_prefix])]
    required = {f.name: tyro.MISSING for f in dataclasses.fields(cls) if _is_required(f)}
    defaults: dict[str, Any] = {"options": cls(**required)}
    if config is not None:
        types = type(config)[type(config.env), type(config.algorithm)]  # pyrefly: ignore
        fields.append(("settings", Annotated[tyro.conf.FlagConversionOff[types], no_prefix]))
        defaults["settings"] = config
        summary = f"{summary} The defaults shown include the rest of the command line."
    # tyro joins lines that begin with a letter: these begin with a space or a hyphen.
    description = "\n".join(map(fill, [summary, *(_names() if config is not None else [])]))
    arguments = dataclasses.make_dataclass("Arguments", fields, frozen=True)
    with contextlib.suppress(SystemExit), _rules():
        tyro.cli(
            arguments,
            default=arguments(**defaults),
            args=["--help"],
            prog=f"python -m hmasd_jax.train {command}",
            description=description,
        )


def _names() -> list[str]:
    """Return sentences with the names of all environments and algorithms."""
    from envs_jax.registry import ENVIRONMENTS
    from hmasd_jax.algorithms import ALGORITHMS

    return [
        f"--env.name is one of {', '.join(ENVIRONMENTS)}.",
        f"--algorithm.name is one of {', '.join(ALGORITHMS)}.",
    ]


def _rules() -> ConstructorRegistry:
    """Return rules by which tyro shows fields."""
    registry = ConstructorRegistry()
    registry.primitive_rule(_by_name)
    nested: list[StructTypeInfo] = []

    @registry.struct_rule
    def in_whole_lines(info: StructTypeInfo) -> StructConstructorSpec | None:
        """Let paragraphs of docstrings break where the terminal ends, not where the source does."""
        if nested or not dataclasses.is_dataclass(info.type):
            return None
        nested.append(info)  # tyro asks this rule again, and then its own ones.
        spec = ConstructorRegistry.get_struct_spec(info)
        nested.clear()
        assert isinstance(spec, StructConstructorSpec)
        fields = (dataclasses.replace(x, helptext=partial(_help_of, x)) for x in spec.fields)
        return dataclasses.replace(spec, fields=tuple(fields))

    return registry


def _by_name(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """Show a field that takes a name or an object, such as a scenario, as a name only."""
    if str not in get_args(info.type) or get_origin(info.type) is tuple:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="NAME",
        instance_from_str=lambda words: words[0],
        is_instance=lambda value: isinstance(value, str),
        str_from_instance=lambda value: [value],
    )


def _help_of(field: StructFieldSpec) -> str | None:
    """Return the help of a field in whole paragraphs."""
    text = field.helptext() if callable(field.helptext) else field.helptext
    return None if text is None else unbreak(text)


def _is_required(option: dataclasses.Field) -> bool:
    return option.default is option.default_factory is dataclasses.MISSING
