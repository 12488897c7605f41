"""Statistics over seeds: what curves and tables of results are made of. NumPy only.

`values` has one row per seed and one column per evaluation; `scores` one number per seed.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class Summary(TypedDict):
    """Of the scores of all seeds; the two ends of `interval` enclose the mean."""

    seeds: int
    mean: float
    std: float
    iqm: float
    interval: tuple[float, float]
    min: float
    max: float
    fraction_solved: float


def mean_and_std(values: ArrayLike) -> tuple[Array, Array]:
    """Mean and population standard deviation over seeds (the first axis)."""
    values = np.asarray(values, float)
    return values.mean(axis=0), values.std(axis=0)


def interquartile_mean(values: ArrayLike) -> Array:
    """Mean over seeds (the first axis) without the lowest and the highest quarter of them.

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
    """Percentile interval of `statistic` by the stratified bootstrap.

    Args:
        groups: one array (seeds, ...) per stratum, e.g. per task or per algorithm. The seeds of
            each are drawn anew, with replacement, independently of the other strata.
        statistic: maps arrays like `groups` to a number or an array.
        rng: source of randomness; the same generator state gives the same interval.
        num_samples: bootstrap samples.
        level: probability that the interval is to have.

    Returns:
        Lower and upper ends, of the statistic's shape.
    """
    arrays = [np.asarray(group, float) for group in groups]

    def resample() -> ArrayLike:
        return statistic([a[rng.integers(len(a), size=len(a))] for a in arrays])

    samples = np.asarray([resample() for _ in range(num_samples)])
    tail = (1.0 - level) / 2.0
    low, high = np.quantile(samples, [tail, 1.0 - tail], axis=0)
    return low, high


class Estimate(NamedTuple):
    """A statistic of the seeds at hand, and its 95 % bootstrap interval."""

    value: float
    low: float
    high: float


def estimate(
    groups: Sequence[ArrayLike], statistic: Callable[[list[Array]], ArrayLike], seed: int = 0
) -> Estimate:
    """`statistic` of `groups`, one per stratum as in `bootstrap_interval`."""
    arrays = [np.asarray(group, float) for group in groups]
    low, high = bootstrap_interval(arrays, statistic, np.random.default_rng(seed))
    return Estimate(float(np.asarray(statistic(arrays))), float(low), float(high))


def estimate_fraction(scores: ArrayLike, threshold: float) -> Estimate:
    """`fraction_above` with its Wilson interval, which also holds if all seeds agree.

    Of ten seeds that all learn, the bootstrap would say that none can ever fail.
    """
    n, z2 = np.size(scores), 1.959964**2
    p = fraction_above(scores, threshold)
    center = (p + z2 / (2 * n)) / (1 + z2 / n)
    half = np.sqrt(z2 * (p * (1 - p) / n + z2 / (4 * n**2))) / (1 + z2 / n)
    return Estimate(p, max(float(center - half), 0.0), min(float(center + half), 1.0))


def probability_of_improvement(scores: ArrayLike, other: ArrayLike) -> float:
    """Probability that a seed with one of `scores` is better than one of `other`; ties count half.

    References:
        Agarwal et al., 2021, as in `interquartile_mean`: the Mann-Whitney U over all pairs
    """
    difference = np.asarray(scores, float)[:, None] - np.asarray(other, float)
    return float(((1 + np.sign(difference)) / 2).mean())


def mean_interval(values: ArrayLike, seed: int = 0) -> tuple[Array, Array]:
    """95 % interval of the mean over seeds, per evaluation; whole curves are drawn."""
    rng = np.random.default_rng(seed)
    return bootstrap_interval([values], lambda groups: groups[0].mean(axis=0), rng)


def last_evaluations(values: ArrayLike, count: int) -> Array:
    """One score per seed: the mean of its last `count` evaluations.

    Raises:
        ValueError: there are fewer evaluations.
    """
    values = np.asarray(values, float)
    if not 1 <= count <= values.shape[1]:
        raise ValueError(f"cannot take the last {count} of {values.shape[1]} evaluations")
    return values[:, -count:].mean(axis=1)


def fraction_above(scores: ArrayLike, threshold: float) -> float:
    """Fraction of seeds whose score is at least `threshold`."""
    return float(np.mean(np.asarray(scores, float) >= threshold))


def summarize(scores: ArrayLike, solved_at: float = 0.9, seed: int = 0) -> Summary:
    """All that a table of results says about the scores of one algorithm on one task.

    Args:
        scores: one per seed, e.g. of `last_evaluations`.
        solved_at: score from which on a seed counts as solved.
        seed: of the bootstrap.
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
