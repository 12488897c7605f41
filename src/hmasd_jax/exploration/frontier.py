"""Exploration bonus for values of single features that few episodes reach.

An episode is paid when a feature of the state reaches a value for the first time in it: an enemy
with less health than before, a pot with a third onion, a diamond that is gone. A value is reached
when it is taken or passed. By what steps an agent loses its own health is chance, and would pay if
each value had to be hit. Rising to a value and falling to it are counted apart: a shield that
recharges is not a shield that is lost. Each feature is counted by itself, the coarsest of the
projections of the state that CMAE counts in (Liu et al., ICML 2021). Whole states are all new, and
the prediction error of a network on them is dominated by features that always vary. Paying only
first visits of an episode is the restriction of NovelD (Zhang et al., NeurIPS 2021). Without it,
waiting in a rare state pays.

A long episode counts as several, of `period` steps each. Counted whole, what a game of a kitchen
reaches once is mastered, and nothing pays a team for filling its second pot twice a game.

A value that a share p of the episodes reaches is worth 1 / p - 1, the odds against it. Here p is
the largest share so far, measured over recent rollouts: what the team has mastered pays nothing, so
that only the frontier of what it can do is left. The share of the moment would pay for leaving the
solution of a task to do what has become rare. The largest share is forgotten slowly, so that what
the team has lost leads back to the frontier.

A feature that reaches n values in one step is paid the sum of what they are worth, divided by the
root of n. A feature with two values passes all between them at a time. Paid in full, the death of a
unit would be worth as much as the whole health of an enemy, which is lost shot by shot. Paid for
the rarest value alone, to finish an enemy would be worth no more than a shot.

The sum over features is divided by the deviation of all bonuses so far, but by no less than 1, the
odds against a value that half of the episodes reach. Where nearly all is mastered, a smaller unit
would make much of small odds. An agent that begins on one side of a wall or on the other reaches a
place in half of the episodes at most, and would tour its side to be paid for it.

The mean of the rollout is subtracted, so that an average step pays nothing. A bonus that is never
negative pays for every step of life, and so for not fighting, and for not finishing.

The step that solves an episode is paid by its reward alone. When the last enemy is gone, many
features change at once. A bonus for all of them is hundreds of times the usual one, and the first
wins would triple the unit of the bonus, which is the deviation of all bonuses so far.

The bonus is multiplied by the chance that no episode of a batch is solved, one per copy of the
environment. A team that has found out how to win learns from reward alone. Where no episode counts
as solved, as in kitchens, a team that has found one way to earn goes on looking for others. So that
earnings do not drown the bonus, it grows with the largest mean return of an episode so far. It
fades once that return has stopped rising. Otherwise a team would make detours for it for ever.

Pairs of features can be paid, too (`exploration.pairs`), once an episode earns more than one
reward. Single features show a team how to earn one, and a team that earns slowly may have mastered
them all.

The entropy of actions, which also explores, can be weighted by the share of unsolved episodes.
Battles that are won by a sequence of right actions are lost by one that is drawn at random.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from envs_jax import Environment, TimeStep
from hmasd_jax.exploration.bonus import NO_BONUS, Bonus, always_one
from hmasd_jax.exploration.frontier_config import FrontierConfig
from hmasd_jax.exploration.pairs import BINS, find_cells, init_pairs, visit_pairs
from hmasd_jax.exploration.visits import (
    first_visits,
    largest_share,
    mean_of,
    odds_against,
    pay,
    split_episodes,
)
from hmasd_jax.rl import moments
from hmasd_jax.rl.moments import Moments
from hmasd_jax.types import Key

LEAST_RISE = 0.05
"""Part of the best return by which it must exceed the usual one for a full bonus."""


class Frontier(NamedTuple):
    """State of the bonus for E copies of the environment."""

    low: Float[Array, " state"]
    """Smallest value of each feature so far."""
    high: Float[Array, " state"]
    """Largest value of each feature so far."""
    reached: Float[Array, "2 state bins"]
    """Number of recent parts of episodes that reached each bin, rising and falling."""
    parts: Float[Array, " E"]
    """Number of recent parts of episodes of each copy, of at most `period` steps."""
    part_steps: Int[Array, " E"]
    """Steps of the part under way."""
    mastered: Float[Array, "2 state bins"]
    """Largest share of parts so far that reached each bin, less what is forgotten.

    A visit counts at once, and its part when it ends. Where parts are longer than rollouts, the
    share of what is reached early reads too high: 5 % with parts of two rollouts."""
    visited: Bool[Array, "E 2 state bins"]
    """Bins that the part under way has reached, rising and falling."""
    before: Float[Array, "E state"]
    """State before the next step."""
    begins: Bool[Array, " E"]
    """True if the next step is the first of an episode, so that `before` is of another one."""
    episodes: Float[Array, " E"]
    """Number of recent episodes of each copy."""
    successes: Float[Array, " E"]
    """Number of recent episodes of each copy that were solved."""
    returns: Float[Array, ""]
    """Sum of the rewards of recent rollouts."""
    best_return: Float[Array, ""]
    """Largest mean return of an episode so far, at least 1."""
    usual_return: Float[Array, ""]
    """Running mean of `best_return` over `patience` rollouts; 0 until that is above 1."""
    bonuses: Moments
    """Moments of the bonuses so far, which give the bonus its unit."""
    pairs: Any = ()
    """Visits to pairs of features, where they are paid."""


def make_frontier(env: Environment, config: FrontierConfig, num_envs: int) -> Bonus:
    """Build the bonus for `num_envs` copies of `env`. It pays nothing if its weight is 0."""
    if config.coef == 0:
        return NO_BONUS

    def init(key: Key) -> Frontier:
        del key
        bins = (2, env.state_dim, config.num_bins)
        return Frontier(
            low=jnp.full(env.state_dim, jnp.inf),
            high=jnp.full(env.state_dim, -jnp.inf),
            reached=jnp.zeros(bins),
            parts=jnp.ones(num_envs),
            part_steps=jnp.zeros(num_envs, int),
            mastered=jnp.zeros(bins),
            visited=jnp.zeros((num_envs, *bins), bool),
            before=jnp.zeros((num_envs, env.state_dim)),
            begins=jnp.ones(num_envs, bool),
            episodes=jnp.ones(num_envs),
            successes=jnp.zeros(num_envs),
            returns=jnp.float32(0),
            best_return=jnp.float32(1),
            usual_return=jnp.float32(0),
            bonuses=Moments.create(),
            pairs=init_pairs(env.state_dim, num_envs) if config.pair_coef else (),
        )

    def update(frontier: Frontier, outcome: TimeStep, key: Key):
        del key
        # The rollout counts too: without it, the first visits would be worth infinitely much.
        frontier, is_first, part_ends = explore(frontier, outcome, config)
        bonus = pay(is_first, odds_against(frontier.mastered, config.largest_worth)).sum((-2, -1))
        if config.pair_coef:
            frontier, pair_bonus = explore_pairs(frontier, outcome.state, part_ends, config)
            bonus = bonus + config.pair_coef * pair_bonus
        bonus = jnp.where(is_success(outcome), 0.0, bonus)
        seen = moments.update(frontier.bonuses, bonus)
        weight = config.coef * unsolved(frontier) ** num_envs * rise(frontier)
        unit = jnp.sqrt(jnp.maximum(seen.variance, 1.0)) / frontier.best_return
        reward = weight * (bonus - bonus.mean()) / unit
        return frontier._replace(bonuses=seen), reward, {"frontier": bonus.mean()}

    entropy_weight = unsolved if config.fade_entropy else always_one
    return Bonus(init, update, entropy_weight, unsolved)


def unsolved(frontier: Frontier, copies: bool | Bool[Array, " E"] = True) -> Float[Array, ""]:
    """Return the share of recent episodes that were not solved, in the copies that are marked."""
    successes, episodes = (x.sum(where=copies) for x in (frontier.successes, frontier.episodes))
    return 1.0 - mean_of(successes, episodes)


def rise(frontier: Frontier) -> Float[Array, ""]:
    """Return 1 while the best return rises. The value falls to 0 as that return becomes usual."""
    excess = 1.0 - frontier.usual_return / frontier.best_return
    return jnp.minimum(excess / LEAST_RISE, 1.0)


def explore(
    frontier: Frontier, outcome: TimeStep, config: FrontierConfig
) -> tuple[Frontier, Bool[Array, "T E 2 state bins"], Bool[Array, "T E"]]:
    """Count the parts of episodes that reach each bin, the solved episodes, and rewards.

    The first step of an episode reaches nothing: `outcome` does not hold the state that it is taken
    in.

    Args:
        frontier: state before the rollout.
        outcome: (T, E), steps before any reset.
        config: all settings but the weight and the largest worth of the bonus.

    Returns:
        The new state, which bins each step reaches as the first of its part, and whether it ends
        that part.
    """
    states = outcome.state
    frontier = widen(frontier, states.min((0, 1)), states.max((0, 1)))
    before = jnp.concatenate([frontier.before[None], states[:-1]])
    begins = jnp.concatenate([frontier.begins[None], outcome.done[:-1]])
    before = jnp.where(begins[..., None], states, before)
    num_bins = frontier.reached.shape[-1]
    ends = find_bins(frontier, before, num_bins), find_bins(frontier, states, num_bins)
    part_steps, part_ends = split_episodes(frontier.part_steps, outcome.done, config.period)
    visited, is_first = first_visits(frontier.visited, *ends, part_ends)
    keep = 1.0 - 1.0 / config.window
    reached = frontier.reached * keep + is_first.sum((0, 1))
    parts = frontier.parts * keep + part_ends.sum(0)
    episodes = frontier.episodes * keep + outcome.done.sum(0)
    returns = frontier.returns * keep + outcome.reward.sum()
    best_return = jnp.maximum(frontier.best_return, mean_of(returns, episodes.sum()))
    rate = jnp.where(best_return > 1, 1.0 / config.patience, 0.0) if config.patience else 0.0
    frontier = frontier._replace(
        reached=reached,
        parts=parts,
        part_steps=part_steps,
        mastered=largest_share(frontier.mastered, reached, parts.sum(), config.forgetting),
        visited=visited,
        before=states[-1],
        begins=outcome.done[-1],
        episodes=episodes,
        successes=frontier.successes * keep + is_success(outcome).sum(0),
        returns=returns,
        best_return=best_return,
        usual_return=frontier.usual_return + rate * (best_return - frontier.usual_return),
    )
    return frontier, is_first, part_ends


def explore_pairs(
    frontier: Frontier,
    states: Float[Array, "T E state"],
    part_ends: Bool[Array, "T E"],
    config: FrontierConfig,
) -> tuple[Frontier, Float[Array, "T E"]]:
    """Count pairs of features, and return what they pay, once the best return is above 1."""

    def visit(pairs):
        cells = find_cells(find_bins(frontier, states, BINS))
        return visit_pairs(pairs, cells, part_ends, config)

    def skip(pairs):
        return pairs, jnp.zeros(part_ends.shape)

    pairs, bonus = jax.lax.cond(frontier.best_return > 1, visit, skip, frontier.pairs)
    return frontier._replace(pairs=pairs), bonus


def is_success(outcome: TimeStep) -> Bool[Array, "T E"]:
    """Return whether each step ends an episode that is solved.

    `success` in `info` tells. Without it, a positive reward before the time limit does.
    """
    if "success" in outcome.info:
        return outcome.done & (outcome.info["success"] > 0)
    return outcome.terminated & (outcome.reward > 0)


def widen(frontier: Frontier, low: Float[Array, " state"], high: Float[Array, " state"]):
    """Widen the range of each feature to include `low` and `high`.

    What is known of an old bin moves to the new bin that holds its middle. Where several move to
    one, the largest holds: a part that reached two of them reached the new bin once. `visited`
    keeps the old bins until its parts end.
    """
    wider = frontier._replace(
        low=jnp.minimum(frontier.low, low), high=jnp.maximum(frontier.high, high)
    )
    num_bins = frontier.reached.shape[-1]
    middle = (jnp.arange(num_bins)[:, None] + 0.5) / num_bins
    # Before the first rollout there is no range, and nothing to move.
    is_new = frontier.low > frontier.high
    middles = jnp.where(is_new, low, frontier.low + middle * (frontier.high - frontier.low))
    moved = (slice(None), jnp.arange(low.size)[:, None], find_bins(wider, middles, num_bins).T)
    empty = jnp.zeros_like(frontier.reached)
    return wider._replace(
        reached=empty.at[moved].max(frontier.reached),
        mastered=empty.at[moved].max(frontier.mastered),
    )


def find_bins(
    frontier: Frontier, states: Float[Array, "*batch state"], num_bins: int
) -> Int[Array, "*batch state"]:
    """Return the bin of each feature, of `num_bins` between its extremes so far."""
    width = jnp.maximum(frontier.high - frontier.low, 1e-6)
    return jnp.clip((states - frontier.low) / width * num_bins, 0, num_bins - 1).astype(int)
