"""Conversion between environments of this package and those of other libraries.

The packages of the other libraries are optional. They are imported by the first call that needs
them.
"""

from typing import TYPE_CHECKING, Any

from envs_jax.adapters.jaxmarl_import import TeamReward, WrappedJaxMARL
from envs_jax.adapters.jaxmarl_named import JaxMARL
from envs_jax.optional import MissingPackageError, require
from envs_jax.types import Environment

if TYPE_CHECKING:
    from envs_jax.adapters.jaxmarl_export import ExportedEnv
    from envs_jax.adapters.pettingzoo_export import ActionMasks, ExportedParallelEnv

__all__ = [
    "JaxMARL",
    "MissingPackageError",
    "from_jaxmarl",
    "to_jaxmarl",
    "to_pettingzoo",
]


def from_jaxmarl(
    env: Any,
    max_steps: int = 0,
    team_reward: TeamReward = "mean",
    shaped_reward_coef: float = 0.0,
) -> Environment:
    """Convert a JaxMARL environment to an `Environment`; see `jaxmarl_import` for the details.

    Args:
        env: `MultiAgentEnv` of cooperating agents with discrete actions, without wrappers.
        max_steps: Time limit in environment steps. 0 takes that of `env`; a smaller one ends
            episodes earlier.
        team_reward: `mean` or `sum` of the agents' rewards.
        shaped_reward_coef: Coefficient of JaxMARL's `shaped_reward` (Overcooked) in each agent's
            reward.

    Raises:
        ValueError: Actions are continuous, agents oppose each other, the time limit is unknown, or
            a setting is out of range.
    """
    return WrappedJaxMARL(
        env=env,
        max_steps=max_steps,
        team_reward=team_reward,
        shaped_reward_coef=shaped_reward_coef,
    )


def to_jaxmarl(env: Environment) -> "ExportedEnv":
    """Convert an `Environment` to a JaxMARL `MultiAgentEnv`, for its trainers and wrappers.

    Raises:
        MissingPackageError: The package jaxmarl is not installed.
    """
    require("jaxmarl", "compare", "to_jaxmarl")
    from envs_jax.adapters.jaxmarl_export import ExportedEnv

    return ExportedEnv(env)


def to_pettingzoo(
    env: Environment, seed: int = 0, action_masks: "ActionMasks" = "observation"
) -> "ExportedParallelEnv":
    """Convert an `Environment` to a PettingZoo `ParallelEnv`, whose methods are compiled by JAX.

    Args:
        env: Environment to convert.
        seed: Seed of all episodes until `reset(seed=...)` gives another one.
        action_masks: With `observation`, an agent observes a dict of `observation` and
            `action_mask`, as in PettingZoo's own games. With `info`, it observes the vector alone.
            The agent's info contains the mask in both cases.

    Raises:
        MissingPackageError: The package pettingzoo is not installed.
        ValueError: `action_masks` is unknown, or `seed` is negative.
    """
    require("pettingzoo", "pettingzoo", "to_pettingzoo")
    from envs_jax.adapters.pettingzoo_export import ExportedParallelEnv

    return ExportedParallelEnv(env, seed, action_masks)
