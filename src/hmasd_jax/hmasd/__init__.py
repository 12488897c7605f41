"""Hierarchical Multi-Agent Skill Discovery (Yang et al., NeurIPS 2023)."""

from hmasd_jax.hmasd.algorithm import HMASDState, make_hmasd
from hmasd_jax.hmasd.config import HMASDConfig

__all__ = ["HMASDConfig", "HMASDState", "make_hmasd"]
