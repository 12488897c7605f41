"""Programs of a run."""

import jax.numpy as jnp
import pytest

from hmasd_jax.training.compiled import all_finite
from hmasd_jax.types import Learner


@pytest.mark.parametrize("where", ["params", "opt_state", "metrics", None])
def test_a_number_that_is_not_finite_is_found_wherever_it_is(where):
    params, opt_state, metrics = (
        {"x": jnp.array([0.0, jnp.nan if name == where else 1.0])}
        for name in ("params", "opt_state", "metrics")
    )
    state = {"learner": Learner(params, opt_state), "env": jnp.array(jnp.nan)}  # env is not judged
    assert bool(all_finite(state, metrics)) == (where is None)
