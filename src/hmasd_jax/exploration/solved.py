"""Coefficients that change once the team solves its task, for any algorithm that explores.

A task is solved as far as the episodes of all copies of the environment are. The frontier counts
them. Each function returns a constant of Python where its setting leaves the coefficient as it is.
A traced number would round the whole update differently.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

from hmasd_jax.exploration.bonus import Bonus
from hmasd_jax.exploration.frontier_config import FrontierConfig
from hmasd_jax.exploration.greedy_copies import Settings, mark_greedy
from hmasd_jax.validation import check_range, check_types


@dataclass(frozen=True)
class SolvedConfig:
    """Settings of what changes once the task is solved. The paper changes nothing.

    p is the chance that the episodes of all copies of the environment are solved.
    """

    sharpening: float = 0.0
    """Weight against the entropy of actions, times p and the share of episodes that sampled play
    loses and greedy play wins. Needs `imitation.greedy_copies`."""
    step_factor: float = 1.0
    """Factor of the learning rate of the policy of actions and its critic, which falls from 1 as p
    rises."""

    def __post_init__(self) -> None:
        check_types(self)
        check_range(self, "sharpening", low=0)
        check_range(self, "step_factor", low=0, high=1)


@runtime_checkable
class SolvedSettings(Settings, Protocol):
    """Settings of an algorithm that explores and knows when its task is solved."""

    @property
    def frontier(self) -> FrontierConfig:
        """Settings of the bonus that counts solved episodes."""
        ...

    @property
    def solved(self) -> SolvedConfig:
        """Settings of what changes."""
        ...


def check_solved(config: SolvedSettings) -> None:
    """Check that what the settings depend on is counted.

    Raises:
        ValueError: A setting differs from its default, and the frontier pays nothing, or
            `sharpening` is set, and no copy acts greedily.
    """
    for field in dataclasses.fields(config.solved):
        value = getattr(config.solved, field.name)
        if value != field.default and config.frontier.coef == 0:
            raise ValueError(
                f"solved.{field.name} {value} needs frontier.coef above 0: the frontier knows when "
                "the task is solved"
            )
    sharpening = config.solved.sharpening
    if sharpening > 0 and not config.imitation.greedy_copies:
        raise ValueError(
            f"solved.sharpening {sharpening} needs imitation.greedy_copies above 0: they show what "
            "sampling loses"
        )


def solved_chance(
    bonus: Bonus, bonus_state: Any, config: SolvedSettings
) -> float | Float[Array, ""]:
    """Return p, the chance that the episodes of all copies of the environment are solved."""
    return (1.0 - bonus.unsolved(bonus_state)) ** config.ppo.num_envs


def step_factor(bonus: Bonus, bonus_state: Any, config: SolvedSettings) -> float | Float[Array, ""]:
    """Return the factor of a learning rate, which may fall once all copies succeed.

    Normalized advantages have no scale. Where every episode succeeds they are noise, which Adam
    follows in steps of full length, and the policy drifts. Where some episodes fail it still
    learns, and steps in proportion to these would leave the last ones unsolved.
    """
    least = config.solved.step_factor
    if least == 1:
        return 1.0
    return 1.0 - (1.0 - least) * solved_chance(bonus, bonus_state, config)


def actions_entropy_coef(
    bonus: Bonus, bonus_state: Any, config: SolvedSettings, coef: float
) -> float | Float[Array, ""]:
    """Return the coefficient of the actions' entropy, which may fall below 0 on a solved task.

    Actions that are drawn at random lose some episodes which the likeliest ones win. Where nearly
    all are won, few gradients tell the policy so. A negative coefficient then makes its actions
    sure, in proportion to what sampling loses. Where it loses nothing, sure actions would only keep
    the policy from learning the rest.

    Args:
        bonus: bonus that weighs the entropy and counts the solved episodes.
        bonus_state: state of the bonus.
        config: settings of the greedy copies and of sharpening.
        coef: coefficient before the weight of the bonus and before sharpening.
    """
    faded = coef * bonus.entropy_weight(bonus_state)
    if config.solved.sharpening == 0:
        return faded
    greedy = jnp.asarray(mark_greedy(config))
    lost = bonus.unsolved(bonus_state, ~greedy) - bonus.unsolved(bonus_state, greedy)
    chance = solved_chance(bonus, bonus_state, config)
    return faded - config.solved.sharpening * jnp.maximum(lost, 0.0) * chance
