"""HMASD and its baselines as jitted JAX training steps."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hmasd_jax.runs.load import load_policy

__all__ = ["load_policy"]


def __getattr__(name: str) -> Any:
    # Import at first use, so that importing one module does not load all libraries.
    if name == "load_policy":
        from hmasd_jax.runs.load import load_policy

        return load_policy
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
