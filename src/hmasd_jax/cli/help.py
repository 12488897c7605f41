"""Help of a command, which tyro writes from types and docstrings."""

import contextlib
import dataclasses
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from hmasd_jax.cli.options import Options

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
        summary = f"{summary} {_names()}"
    arguments = dataclasses.make_dataclass("Arguments", fields, frozen=True)
    with contextlib.suppress(SystemExit), _objects_by_name():
        tyro.cli(
            arguments,
            default=arguments(**defaults),
            args=["--help"],
            prog=f"python -m hmasd_jax.train {command}",
            description=summary,
        )


def _names() -> str:
    """Return sentences with the names of all environments and algorithms."""
    from envs_jax.registry import ENVIRONMENTS
    from hmasd_jax.algorithms import ALGORITHMS

    return (
        f"--env.name is one of {', '.join(ENVIRONMENTS)}; --algorithm.name is one of "
        f"{', '.join(ALGORITHMS)}. The defaults shown include the rest of the command line."
    )


def _objects_by_name() -> ConstructorRegistry:
    """Show a field that takes a name or an object, such as a scenario, as a name only."""
    registry = ConstructorRegistry()

    @registry.primitive_rule
    def by_name(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        if str not in get_args(info.type) or get_origin(info.type) is tuple:
            return None
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar="NAME",
            instance_from_str=lambda words: words[0],
            is_instance=lambda value: isinstance(value, str),
            str_from_instance=lambda value: [value],
        )

    return registry


def _is_required(option: dataclasses.Field) -> bool:
    return option.default is option.default_factory is dataclasses.MISSING
