"""Environments of other libraries as ours, and ours as theirs.

Their packages are optional, and imported when one of these functions is called.
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
    """An environment of JaxMARL as one of ours; `jaxmarl_import` tells how each part is made.

    Args:
        env: a `MultiAgentEnv` of cooperating agents with discrete actions, not wrapped.
        max_steps: time limit in environment steps; 0 takes theirs, and a smaller one cuts earlier.
        team_reward: `mean` or `sum` of the agents' rewards.
        shaped_reward_coef: what their `shaped_reward` (Overcooked) counts in each agent's reward.

    Raises:
        ValueError: continuous actions, agents that oppose each other, an unknown time limit, or
            a setting out of range.
    """
    return WrappedJaxMARL(
        env=env,
        max_steps=max_steps,
        team_reward=team_reward,
        shaped_reward_coef=shaped_reward_coef,
    )


def to_jaxmarl(env: Environment) -> "ExportedEnv":
    """One of our environments as a `MultiAgentEnv` of JaxMARL, for its trainers and wrappers.

    Raises:
        MissingPackageError: jaxmarl is not installed.
    """
    require("jaxmarl", "compare", "to_jaxmarl")
    from envs_jax.adapters.jaxmarl_export import ExportedEnv

    return ExportedEnv(env)


def to_pettingzoo(
    env: Environment, seed: int = 0, action_masks: "ActionMasks" = "observation"
) -> "ExportedParallelEnv":
    """One of our environments as a `ParallelEnv` of PettingZoo, compiled inside.

    Args:
        env: the environment.
        seed: source of its randomness until `reset(seed=...)` gives another.
        action_masks: with `observation`, an agent observes a dict of `observation` and
            `action_mask`, as in PettingZoo's own games; with `info`, the vector alone. The mask is
            in the agent's info in any case.

    Raises:
        MissingPackageError: pettingzoo is not installed.
        ValueError: `action_masks` is something else, or `seed` negative.
    """
    require("pettingzoo", "pettingzoo", "to_pettingzoo")
    from envs_jax.adapters.pettingzoo_export import ExportedParallelEnv

    return ExportedParallelEnv(env, seed, action_masks)
