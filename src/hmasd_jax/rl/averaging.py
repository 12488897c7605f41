"""Average of the parameters over recent updates (Polyak and Juditsky, 1992).

The greedy action of a policy that keeps learning may change with every update. That of the average
changes slowly, so it acts in evaluation. Training goes on from the last parameters.
"""

from typing import Any, NamedTuple, cast

import jax
import optax
from jax.flatten_util import ravel_pytree

from hmasd_jax.types import Learner


class AverageState(NamedTuple):
    """State of `track_average`."""

    average: optax.Params
    """Average of the parameters, with exponential weights."""
    ema: optax.OptState


def track_average(decay: float) -> optax.GradientTransformation:
    """Keep an average of the parameters, and leave the updates as they are.

    It must come last in a chain, where the updates are what is added to the parameters.

    Args:
        decay: weight of the past per gradient step.
    """
    ema = optax.ema(decay)

    def init(params):
        return AverageState(params, ema.init(params))

    def update(updates, state, params=None):
        after = optax.apply_updates(cast(optax.Params, params), updates)
        average, moments = ema.update(after, state.ema)
        return updates, AverageState(average, moments)

    return optax.GradientTransformation(init, update)


def averaged_params(learner: Learner) -> dict[str, Any]:
    """Return the average of each network's parameters, or the parameters if none is kept."""
    states = cast(optax.PartitionState, learner.opt_state).inner_states

    def average_of(name: str, params: Any) -> Any:
        average = optax.tree.get(states[name], "average")
        return params if average is None else unravel(average, params)

    def unravel(average: Any, params: Any) -> Any:
        if average.ndim > 1:  # An axis of agents, as in EITI, is before all others.
            return jax.vmap(unravel)(average, params)
        return ravel_pytree(params)[1](average)

    return {name: average_of(name, params) for name, params in learner.params.items()}
