"""Multi-agent environments as pure JAX functions. Imports nothing of `hmasd_jax`."""

from envs_jax.check import EnvironmentCheckError, check_environment
from envs_jax.registry import make, names, register
from envs_jax.types import Environment, EnvState, TimeStep

__all__ = [
    "EnvState",
    "Environment",
    "EnvironmentCheckError",
    "TimeStep",
    "check_environment",
    "make",
    "names",
    "register",
]
