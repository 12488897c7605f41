"""ValueNorm against hand arithmetic with on-policy's constants."""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

from hmasd_jax.rl.value_norm import ValueNorm, denormalize, normalize, statistics, update


def test_before_any_data_the_mean_is_0_and_the_deviation_0_1():
    # mean = 0 / max(0, 1e-5) = 0; variance = max(0 - 0, 1e-2), so the deviation is 0.1.
    mean, std = statistics(ValueNorm.create())
    assert_allclose([mean, std], [0.0, 0.1], rtol=1e-6)


def test_one_batch_gives_exactly_its_mean_and_population_deviation():
    # Targets 1, 2, 6: mean 3, mean square 41/3, variance 41/3 - 9 = 14/3. All three averages
    # carry the same factor 1e-5, which cancels.
    norm = update(ValueNorm.create(), jnp.array([[1.0], [2.0], [6.0]]))
    assert_allclose([norm.mean, norm.square, norm.weight], [3e-5, 41e-5 / 3, 1e-5], rtol=1e-5)
    assert_allclose(statistics(norm), [3.0, np.sqrt(14 / 3)], rtol=1e-5)


def test_two_batches_are_averaged_with_decay():
    # b = 0.99999. After targets {0} and then {10}:
    #   mean   = b * 0 + (1 - b) * 10  = 1e-4
    #   weight = b * 1e-5 + 1e-5       = 1.99999e-5
    #   debiased mean = 1e-4 / 1.99999e-5 = 5.000025
    norm = ValueNorm.create()
    for target in (0.0, 10.0):
        norm = update(norm, jnp.array([target]))
    assert_allclose([norm.mean, norm.weight], [1e-4, 1.99999e-5], rtol=1e-5)
    assert_allclose(statistics(norm)[0], 5.000025, rtol=1e-5)


def test_the_variance_is_floored_at_1e_2():
    # Targets 5 +- 0.01 have variance 1e-4; the deviation used is sqrt(1e-2).
    norm = update(ValueNorm.create(), jnp.array([4.99, 5.01]))
    assert_allclose(normalize(norm, jnp.array([5.0, 5.3])), [0.0, 3.0], atol=1e-3)


def test_denormalize_undoes_normalize():
    norm = update(ValueNorm.create(), jnp.array([1.0, 4.0, 8.0]))
    x = jnp.linspace(-20.0, 20.0, 9)
    assert_allclose(denormalize(norm, normalize(norm, x)), x, atol=1e-5)
    # 13/3 is the mean; (1 + 16 + 64)/3 - (13/3)^2 = 74/9 the variance.
    assert_allclose(normalize(norm, x), (x - 13 / 3) / np.sqrt(74 / 9), rtol=1e-4, atol=1e-5)


def test_statistics_follow_all_of_training_not_the_latest_batches():
    # 1e3 updates at 0, then as many at 8: far fewer than 1 / (1 - b), so about their average.
    def repeat(norm, target, times):
        return jax.lax.fori_loop(0, times, lambda _, n: update(n, target), norm)

    norm = repeat(ValueNorm.create(), jnp.zeros(2), 1000)
    norm = repeat(norm, jnp.full(2, 8.0), 1000)
    mean, std = statistics(norm)
    assert_allclose([mean, std], [4.0, 4.0], rtol=1e-2)
