"""Running moments against those of all samples at once."""

import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

from hmasd_jax.rl import moments
from hmasd_jax.rl.moments import Moments


def test_batches_of_any_size_merge_to_the_moments_of_all_samples():
    rng = np.random.default_rng(0)
    batches = [rng.normal(3.0 * i, 1.0 + i, size=(n, 4)) for i, n in enumerate((5, 1, 40))]
    merged = Moments.create(4)
    for batch in batches:
        merged = moments.update(merged, jnp.asarray(batch))
    everything = np.concatenate(batches)
    assert_allclose(merged.mean, everything.mean(0), rtol=1e-5)
    assert_allclose(merged.variance, everything.var(0), rtol=1e-5)
    assert merged.count == 46


def test_all_leading_axes_are_samples():
    x = np.random.default_rng(1).normal(size=(3, 5, 2)).astype(np.float32)
    merged = moments.update(Moments.create(2), x)
    assert_allclose(merged.variance, x.reshape(-1, 2).var(0), rtol=1e-5)
    assert merged.count == 15


def test_scalars_have_moments_too():
    merged = moments.update(Moments.create(), jnp.array([1.0, 3.0]))
    assert_allclose((merged.mean, merged.variance, merged.count), (2.0, 1.0, 2.0))


def test_standardized_inputs_are_clipped_and_constant_features_stay_small():
    x = np.array([[0.0, 7.0], [2.0, 7.0]], np.float32)
    merged = moments.update(Moments.create(2), x)
    assert_allclose(moments.standardize(merged, x, 5.0), [[-1, 0], [1, 0]], atol=1e-3)
    # 9 is 8 deviations from the mean 1; 7.01 is 0.01 / sqrt(1e-4) = 1 from the constant.
    new = np.array([9.0, 7.01], np.float32)
    assert_allclose(moments.standardize(merged, new, 5.0), [5.0, 1.0], rtol=1e-2)
