"""Hierarchical Multi-Agent Skill Discovery (Yang et al., NeurIPS 2023)."""

from typing import TYPE_CHECKING, Any

from hmasd_jax.hmasd.config import HMASDConfig

if TYPE_CHECKING:
    from hmasd_jax.hmasd.algorithm import HMASDState, make_hmasd

__all__ = ["HMASDConfig", "HMASDState", "make_hmasd"]


def __getattr__(name: str) -> Any:
    """Import the algorithm when first asked for: its settings alone load in a second."""
    if name in __all__:
        from hmasd_jax.hmasd import algorithm

        return getattr(algorithm, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
