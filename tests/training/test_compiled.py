"""Programs of a run."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hmasd_jax.config import TrainConfig
from hmasd_jax.training.compiled import all_finite, evaluation_key, seed_key
from hmasd_jax.types import Learner


@pytest.mark.parametrize("where", ["params", "opt_state", "metrics", None])
def test_a_number_that_is_not_finite_is_found_wherever_it_is(where):
    params, opt_state, metrics = (
        {"x": jnp.array([0.0, jnp.nan if name == where else 1.0])}
        for name in ("params", "opt_state", "metrics")
    )
    state = {"learner": Learner(params, opt_state), "env": jnp.array(jnp.nan)}  # env is not judged
    assert bool(all_finite(state, metrics)) == (where is None)


def test_each_training_and_each_evaluation_draws_with_a_key_of_its_own():
    config, seeds, steps = TrainConfig(), range(3), (0, 80_000, 2**32 + 80_000)
    keys = [seed_key(config, seed) for seed in seeds]
    keys += [evaluation_key(config, *x) for x in product(seeds, steps)]
    assert len(np.unique(jax.random.key_data(jnp.stack(keys)), axis=0)) == 12
