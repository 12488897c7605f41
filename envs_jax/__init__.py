"""Multi-agent environments as pure JAX functions. The package does not depend on `hmasd_jax`."""

from envs_jax.adapters import MissingPackageError, from_jaxmarl, to_jaxmarl, to_pettingzoo
from envs_jax.check import EnvironmentCheckError, check_environment
from envs_jax.random_play import random_actions
from envs_jax.registry import make, names, register
from envs_jax.types import Environment, EnvState, TimeStep

__all__ = [
    "EnvState",
    "Environment",
    "EnvironmentCheckError",
    "MissingPackageError",
    "TimeStep",
    "check_environment",
    "from_jaxmarl",
    "make",
    "names",
    "random_actions",
    "register",
    "to_jaxmarl",
    "to_pettingzoo",
]
