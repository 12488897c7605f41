"""Simplified Overcooked: two cooks, one kitchen, soups of three onions."""

from envs_jax.overcooked.environment import Overcooked, OvercookedState
from envs_jax.overcooked.layouts import LAYOUTS

__all__ = ["LAYOUTS", "Overcooked", "OvercookedState"]
