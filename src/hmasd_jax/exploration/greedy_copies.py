"""Copies of the environment that act greedily in training.

A team that has just learned to win often does so greedily long before it does by chance: one action
at random loses a battle that takes a hundred right ones. A few copies of the environment therefore
may act greedily, so that there are successes to imitate. The policy gradient takes from them only
what goes wrong although teams that sample succeed. Their better actions would make what is likely
likelier still. Without the worse ones, greedy play could wait for ever, and a team that samples
would never know.
"""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hmasd_jax.exploration.successes import ImitationConfig
from hmasd_jax.rl.ppo import PPOConfig, has_choice


@runtime_checkable
class Settings(Protocol):
    """Settings of an algorithm that can imitate its own successes."""

    @property
    def ppo(self) -> PPOConfig:
        """Settings of PPO."""
        ...

    @property
    def imitation(self) -> ImitationConfig:
        """Settings of imitation."""
        ...


def mark_greedy(config: Settings) -> bool | Bool[Array, " E"]:
    """Mark the copies that act greedily, which are the first; False if there is none."""
    count = config.imitation.greedy_copies
    return jnp.arange(config.ppo.num_envs) < count if count else False


def per_agent(greedy: bool | Bool[Array, " E"]) -> bool | Bool[Array, "E 1"]:
    """Return `greedy` with an axis for the agents."""
    return greedy if isinstance(greedy, bool) else greedy[:, None]


def leave_out(
    chosen: Bool[Array, "*batch"], copies: bool | Bool[Array, "..."]
) -> Bool[Array, "*batch"]:
    """Leave out the copies that are marked; `copies` is broadcast, and False if there is none."""
    return chosen if copies is False else chosen & ~copies


def blame_greedy(
    advantage: Float[Array, "T E N"],
    greedy: bool | Bool[Array, " E"],
    reward: Float[Array, "T E"],
) -> Float[Array, "T E N"]:
    """Replace normalized advantages A of copies that act greedily by w min(A + 1, 0).

    A greedy action that is more than one deviation worse than the mean is made less likely, and
    none is made likelier. The weight w is the share of the other copies that the environment
    rewarded in the rollout: where sampled play hardly succeeds, greedy play is not to blame.
    """
    if greedy is False:
        return advantage
    weight = (reward > 0).any(axis=0).mean(where=~greedy)
    return jnp.where(per_agent(greedy), weight * jnp.minimum(advantage + 1.0, 0.0), advantage)


def normalize_and_blame(
    advantage: Float[Array, "T E N"],
    action_mask: Bool[Array, "T E N actions"],
    reward: Float[Array, "T E"],
    greedy: bool | Bool[Array, " E"],
    normalize: Callable[[Array, Array], Array],
) -> Float[Array, "T E N"]:
    """Normalize advantages over agents with a choice in copies that sample, and blame the others.

    Args:
        advantage: advantages of all copies.
        action_mask: True for actions that agents can take.
        reward: rewards of the environment.
        greedy: True for copies that act greedily; False if there is none.
        normalize: function of the advantages, and of whether each counts.
    """
    active = leave_out(has_choice(action_mask), per_agent(greedy))
    return blame_greedy(normalize(advantage, active), greedy, reward)
