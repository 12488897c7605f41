import numpy as np
import pytest

from hmasd_jax.analysis import statistics

# Five seeds, three evaluations.
VALUES = [
    [0.0, 0.2, 1.0],
    [0.0, 0.4, 1.0],
    [0.0, 0.6, 0.9],
    [0.0, 0.8, 0.8],
    [0.5, 1.0, 0.3],
]


def test_mean_and_population_std():
    mean, std = statistics.mean_and_std(VALUES)
    # Column 1: mean 3 / 5 = 0.6; deviations +-0.4, +-0.2, 0: sqrt((2 * 0.16 + 2 * 0.04) / 5)
    np.testing.assert_allclose(mean, [0.1, 0.6, 0.8])
    # Column 0: deviations -0.1 (four times) and 0.4: sqrt((4 * 0.01 + 0.16) / 5) = 0.2
    # Column 2: 0.2, 0.2, 0.1, 0, -0.5: sqrt((2 * 0.04 + 0.01 + 0.25) / 5) = sqrt(0.068)
    np.testing.assert_allclose(std, [0.2, np.sqrt(0.08), np.sqrt(0.068)])


def test_interquartile_mean_drops_a_quarter_at_each_end():
    # 5 // 4 = 1 seed at each end: (0.4 + 0.6 + 0.8) / 3, and (0.8 + 0.9 + 1.0) / 3.
    np.testing.assert_allclose(statistics.interquartile_mean(VALUES), [0.0, 0.6, 0.9])
    # 8 // 4 = 2: (3 + 4 + 5 + 6) / 4
    assert statistics.interquartile_mean([100, 1, 2, 3, 4, 5, 6, -100]) == 3.5
    # Fewer than four seeds: nothing is dropped.
    assert statistics.interquartile_mean([0.0, 0.0, 3.0]) == 1.0


def test_bootstrap_of_two_seeds_is_the_binomial():
    # The mean of two draws from {0, 1} is 0, 1/2, 1 with probabilities 1/4, 1/2, 1/4: the 50 %
    # interval (quantiles 0.25, 0.75) lies at the steps, the 40 % one (0.3, 0.7) at 1/2.
    rng = np.random.default_rng(0)
    mean = lambda groups: groups[0].mean()  # noqa: E731
    low, high = statistics.bootstrap_interval([[0, 1]], mean, rng, 4000, level=0.4)
    assert (low, high) == (0.5, 0.5)
    low, high = statistics.bootstrap_interval([[0, 1]], mean, rng, 4000, level=0.95)
    assert (low, high) == (0.0, 1.0)


def test_bootstrap_interval_has_the_width_of_the_normal_approximation():
    scores = np.random.default_rng(1).normal(2.0, 3.0, size=400)
    low, high = statistics.mean_interval(scores)
    half = 1.96 * scores.std() / np.sqrt(400)
    np.testing.assert_allclose([low, high], scores.mean() + half * np.array([-1, 1]), atol=0.05)


def test_bootstrap_is_stratified():
    # Within each stratum all seeds agree, so resampling inside strata cannot change the mean.
    groups = [np.zeros(3), np.ones(7)]
    statistic = lambda groups: np.mean([g.mean() for g in groups])  # noqa: E731
    low, high = statistics.bootstrap_interval(groups, statistic, np.random.default_rng(0), 50)
    assert (low, high) == (0.5, 0.5)


def test_bootstrap_is_seeded_and_per_evaluation():
    low, high = statistics.mean_interval(VALUES, seed=3)
    again = statistics.mean_interval(VALUES, seed=3)
    assert low.shape == (3,)
    np.testing.assert_array_equal((low, high), again)
    mean, _ = statistics.mean_and_std(VALUES)
    assert (low <= mean).all()
    assert (mean <= high).all()


def test_last_evaluations():
    np.testing.assert_allclose(statistics.last_evaluations(VALUES, 2), [0.6, 0.7, 0.75, 0.8, 0.65])
    for count in (0, 4):
        with pytest.raises(ValueError, match=f"last {count} of 3 evaluations"):
            statistics.last_evaluations(VALUES, count)


def test_fraction_above_counts_the_threshold_itself():
    assert statistics.fraction_above([0.9, 0.89, 1.0, 0.0], 0.9) == 0.5


def test_summary():
    summary = statistics.summarize([1.0, 1.0, 0.9, 0.8, 0.3])
    assert summary["seeds"] == 5
    assert summary["mean"] == pytest.approx(0.8)
    assert summary["std"] == pytest.approx(np.sqrt(0.068))
    assert summary["iqm"] == pytest.approx(0.9)
    assert (summary["min"], summary["max"]) == (0.3, 1.0)
    assert summary["fraction_solved"] == pytest.approx(0.6)
    low, high = summary["interval"]
    assert 0.3 <= low < 0.8 < high <= 1.0


def test_summary_of_one_seed_has_no_width():
    assert statistics.summarize([0.7])["interval"] == (0.7, 0.7)


def test_probability_of_improvement_over_all_pairs():
    # Of the six pairs 3 > 1, 3 > 2, 1 < 2, 3 = 3, 1 = 1, 1 < 3: (2 + 2 / 2) / 6
    assert statistics.probability_of_improvement([3, 1], [1, 2, 3]) == 0.5
    assert statistics.probability_of_improvement([5.0, 6.0], [1.0]) == 1.0
    assert statistics.probability_of_improvement([0.0, 0.0], [0.0]) == 0.5


def test_estimate_is_the_statistic_and_its_interval():
    found = statistics.estimate([[0.0, 1.0], [0.5]], lambda groups: groups[0].mean() - 0.5)
    assert found == (0.0, -0.5, 0.5)


def test_iqm_has_its_own_interval():
    found = statistics.estimate_iqm([0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    # Two seeds of eight are cut at each end, and three zeros of eight come up once in fifteen.
    assert (found.value, found.high) == (1.0, 1.0)
    assert found.low == 0.75
    assert statistics.estimate_iqm([0.7]) == (0.7, 0.7, 0.7)


def test_fraction_has_an_interval_even_if_all_seeds_agree():
    # Wilson's for 10 of 10: 1 / (1 + 1.96^2 / 10); for 5 of 10 as in textbooks 0.237 to 0.763.
    np.testing.assert_allclose(
        statistics.estimate_fraction(np.ones(10), 0.9), (1.0, 10 / (10 + 1.959964**2), 1.0)
    )
    half = statistics.estimate_fraction([0.0] * 5 + [1.0] * 5, 0.9)
    np.testing.assert_allclose(half, (0.5, 0.2366, 0.7634), atol=1e-4)
    assert statistics.estimate_fraction([0.0, 0.0], 0.9).low == 0.0
