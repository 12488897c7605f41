"""Exploration bonus for rare values of single features.

A state is rare if one of its features is: an enemy with less health than ever before, a pot with a
third onion, a diamond that is gone. Whole states are all rare, and the prediction error of a
network on them is dominated by features that always vary, such as positions. So each feature is
counted by itself, the coarsest of the projections of the state that CMAE counts in (Liu et al.,
ICML 2021). A value that was seen n times is worth 1 / sqrt(n), as in MBIE-EB (Strehl and Littman,
2008). Only states whose worth stands out in the rollout are paid: common differences, such as
positions that are not equally frequent, would otherwise be noise beside the other rewards. Measured
in deviations of the rollout, the bonus keeps its size while its target moves to what is still rare.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from envs_jax import Environment
from hmasd_jax.exploration.bonus import NO_BONUS, Bonus
from hmasd_jax.types import Key
from hmasd_jax.validation import check_range


@dataclass(frozen=True)
class CountsConfig:
    """Settings of the bonus."""

    coef: float = 0.0
    """Weight of the bonus in the reward. With 0 there is none."""
    num_bins: int = 20
    """Bins per feature, between the smallest and the largest value so far."""
    threshold: float = 1.0
    """Deviations above the rollout's mean from which a state is paid for what exceeds them."""

    def __post_init__(self) -> None:
        check_range(self, "coef", "threshold", low=0)
        check_range(self, "num_bins", low=2)


class Counts(NamedTuple):
    """State of the bonus: a histogram of each feature of the state."""

    low: Float[Array, " state"]
    """Smallest value so far."""
    high: Float[Array, " state"]
    """Largest value so far."""
    visits: Float[Array, "state bins"]
    """Number of visits to each bin."""


def make_counts(env: Environment, config: CountsConfig) -> Bonus:
    """Build the bonus for `env`."""
    if config.coef == 0:
        return NO_BONUS

    def init(key: Key) -> Counts:
        del key
        return Counts(
            low=jnp.full(env.state_dim, jnp.inf),
            high=jnp.full(env.state_dim, -jnp.inf),
            visits=jnp.zeros((env.state_dim, config.num_bins)),
        )

    def reward(counts: Counts, states: Float[Array, "B state"]) -> Float[Array, " B"]:
        # The rollout counts too: without it, the first visits would be worth infinitely much.
        rarity = measure(count(counts, states), states)
        excess = (rarity - rarity.mean()) / (rarity.std() + 1e-8)
        return config.coef * jax.nn.relu(excess - config.threshold)

    def train(counts: Counts, states: Float[Array, "B state"], key: Key):
        del key
        counts = count(counts, states)
        return counts, {"rarity": measure(counts, states).mean()}

    return Bonus(init, reward, train)


def count(counts: Counts, states: Float[Array, "B state"]) -> Counts:
    """Add states to the histograms."""
    counts = widen(counts, states.min(0), states.max(0))
    bins = find_bins(counts, states)
    return counts._replace(visits=counts.visits.at[jnp.arange(bins.shape[1]), bins].add(1.0))


def measure(counts: Counts, states: Float[Array, "B state"]) -> Float[Array, " B"]:
    """Return the sum over features of 1 / sqrt(n), for states that have been counted."""
    visits = jnp.take_along_axis(counts.visits, find_bins(counts, states).T, axis=1)  # (state, B)
    return jax.lax.rsqrt(visits).sum(0)


def widen(counts: Counts, low: Float[Array, " state"], high: Float[Array, " state"]) -> Counts:
    """Widen the range of each feature to include `low` and `high`.

    The visits of an old bin move to the new bin that holds its middle.
    """
    wider = counts._replace(low=jnp.minimum(counts.low, low), high=jnp.maximum(counts.high, high))
    size, num_bins = counts.visits.shape
    middle = (jnp.arange(num_bins)[:, None] + 0.5) / num_bins
    # Before the first rollout there is no range, and nothing to move.
    is_new = counts.low > counts.high
    middles = jnp.where(is_new, low, counts.low + middle * (counts.high - counts.low))
    bins = find_bins(wider, middles).T
    moved = jnp.zeros_like(counts.visits).at[jnp.arange(size)[:, None], bins].add(counts.visits)
    return wider._replace(visits=moved)


def find_bins(counts: Counts, states: Float[Array, "B state"]) -> Int[Array, "B state"]:
    """Return the bin of each feature."""
    num_bins = counts.visits.shape[1]
    width = jnp.maximum(counts.high - counts.low, 1e-6)
    return jnp.clip((states - counts.low) / width * num_bins, 0, num_bins - 1).astype(int)
