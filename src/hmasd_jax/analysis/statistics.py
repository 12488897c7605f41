"""Statistics over seeds for curves and tables of results, in NumPy.

`values` has one row per seed and one column per evaluation. `scores` has one number per seed.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class Summary(TypedDict):
    """Statistics of the scores of all seeds."""

    seeds: int
    """Number of seeds."""
    mean: float
    std: float
    """Population standard deviation."""
    iqm: float
    """Interquartile mean."""
    interval: tuple[float, float]
    """95 % bootstrap interval of the mean."""
    min: float
    max: float
    fraction_solved: float
    """Fraction of seeds that have solved the task."""


ENOUGH_SEEDS = 5
"""Seeds from which an interval over seeds is worth reading; the paper has 5."""


def few_seeds(count: int) -> str | None:
    """Return a word of warning about statistics over `count` seeds, or None if it is enough."""
    if count >= ENOUGH_SEEDS:
        return None
    seeds = "one seed" if count == 1 else f"{count} seeds"
    return f"Statistics over {seeds} say little: train at least {ENOUGH_SEEDS}."


def mean_and_std(values: ArrayLike) -> tuple[Array, Array]:
    """Return mean and population standard deviation over seeds (the first axis)."""
    values = np.asarray(values, float)
    return values.mean(axis=0), values.std(axis=0)


def interquartile_mean(values: ArrayLike) -> Array:
    """Return the mean over seeds (the first axis) without their lowest and highest quarter.

    A quarter is rounded down to whole seeds: of five seeds, the middle three count.

    References:
        Agarwal et al., `Deep Reinforcement Learning at the Edge of the Statistical Precipice
        <https://arxiv.org/abs/2108.13264>`_, 2021
    """
    values = np.sort(np.asarray(values, float), axis=0)
    cut = len(values) // 4
    return values[cut : len(values) - cut].mean(axis=0)


def bootstrap_interval(
    groups: Sequence[ArrayLike],
    statistic: Callable[[list[Array]], ArrayLike],
    rng: np.random.Generator,
    num_samples: int = 2000,
    level: float = 0.95,
) -> tuple[Array, Array]:
    """Return the percentile interval of `statistic` from the stratified bootstrap.

    Args:
        groups: One array (seeds, ...) per stratum, e.g. per task or per algorithm. The seeds of
            each are resampled with replacement, independently of the other strata.
        statistic: Function from arrays like `groups` to a number or an array.
        rng: Source of randomness. The same generator state gives the same interval.
        num_samples: Number of bootstrap samples.
        level: Confidence level of the interval.

    Returns:
        Lower and upper ends, each with the shape of the statistic.
    """
    arrays = [np.asarray(group, float) for group in groups]

    def resample() -> ArrayLike:
        return statistic([a[rng.integers(len(a), size=len(a))] for a in arrays])

    samples = np.asarray([resample() for _ in range(num_samples)])
    tail = (1.0 - level) / 2.0
    low, high = np.quantile(samples, [tail, 1.0 - tail], axis=0)
    return low, high


class Estimate(NamedTuple):
    """A statistic of the seeds and its 95 % interval."""

    value: float
    low: float
    high: float


def estimate(
    groups: Sequence[ArrayLike], statistic: Callable[[list[Array]], ArrayLike], seed: int = 0
) -> Estimate:
    """Return `statistic` of `groups` (one per stratum) with its bootstrap interval."""
    arrays = [np.asarray(group, float) for group in groups]
    low, high = bootstrap_interval(arrays, statistic, np.random.default_rng(seed))
    return Estimate(float(np.asarray(statistic(arrays))), float(low), float(high))


def estimate_mean(values: ArrayLike, seed: int = 0, num_samples: int = 2000) -> Estimate:
    """Return the mean of (n,) with its 95 % bootstrap interval. It is faster than `estimate`."""
    values = np.asarray(values, float)
    rng = np.random.default_rng(seed)
    means = values[rng.integers(len(values), size=(num_samples, len(values)))].mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return Estimate(float(values.mean()), float(low), float(high))


def estimate_iqm(scores: ArrayLike) -> Estimate:
    """Return `interquartile_mean` of (n,) with its 95 % bootstrap interval."""
    return estimate([scores], lambda groups: interquartile_mean(groups[0]))


def estimate_fraction(scores: ArrayLike, threshold: float) -> Estimate:
    """Return `fraction_above` with its Wilson interval.

    If all seeds learn, the bootstrap interval has width 0, as if no seed could ever fail. The
    Wilson interval also holds then.
    """
    n, z2 = np.size(scores), 1.959964**2
    p = fraction_above(scores, threshold)
    center = (p + z2 / (2 * n)) / (1 + z2 / n)
    half = np.sqrt(z2 * (p * (1 - p) / n + z2 / (4 * n**2))) / (1 + z2 / n)
    return Estimate(p, max(float(center - half), 0.0), min(float(center + half), 1.0))


def probability_of_improvement(scores: ArrayLike, other: ArrayLike) -> float:
    """Return the probability that a seed of `scores` is better than one of `other`.

    It is the Mann-Whitney U statistic divided by the number of pairs. Ties count half.

    References:
        Agarwal et al., 2021, as in `interquartile_mean`
    """
    difference = np.asarray(scores, float)[:, None] - np.asarray(other, float)
    return float(((1 + np.sign(difference)) / 2).mean())


def mean_interval(values: ArrayLike, seed: int = 0) -> tuple[Array, Array]:
    """Return the 95 % interval of the mean over seeds for each evaluation.

    The bootstrap resamples whole curves.
    """
    rng = np.random.default_rng(seed)
    return bootstrap_interval([values], lambda groups: groups[0].mean(axis=0), rng)


def seed_score(evaluations: Sequence[float], last: int) -> float:
    """Return the score of one seed: the mean of its `last` evaluations, of all if it has fewer.

    Args:
        evaluations: At least one, without that of the untrained policy.
        last: Number of evaluations to average.
    """
    return float(np.mean(evaluations[-last:]))


def last_evaluations(values: Iterable[ArrayLike], count: int) -> Array:
    """Return one score per seed, the mean of its last `count` evaluations.

    Seeds may have different numbers of evaluations.

    Raises:
        ValueError: A seed has fewer evaluations.
    """
    rows = [np.asarray(row, float) for row in values]
    fewest = min(map(len, rows))
    if not 1 <= count <= fewest:
        raise ValueError(f"cannot take the last {count} of {fewest} evaluations")
    return np.stack([row[-count:] for row in rows]).mean(axis=1)


def fraction_above(scores: ArrayLike, threshold: float) -> float:
    """Return the fraction of seeds with a score of at least `threshold`."""
    return float(np.mean(np.asarray(scores, float) >= threshold))


def summarize(scores: ArrayLike, solved_at: float = 0.9, seed: int = 0) -> Summary:
    """Summarize the scores of one algorithm on one task.

    Args:
        scores: One score per seed, e.g. from `last_evaluations`.
        solved_at: Lowest score of a seed that has solved the task.
        seed: Seed of the bootstrap.
    """
    scores = np.asarray(scores, float)
    low, high = mean_interval(scores, seed)
    mean, std = mean_and_std(scores)
    return Summary(
        seeds=len(scores),
        mean=float(mean),
        std=float(std),
        iqm=float(interquartile_mean(scores)),
        interval=(float(low), float(high)),
        min=float(scores.min()),
        max=float(scores.max()),
        fraction_solved=fraction_above(scores, solved_at),
    )
