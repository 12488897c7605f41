"""Types that all algorithms share. NamedTuples hold arrays, frozen dataclasses hold settings.

Axes, by name: T rollout steps, E environment copies, N agents, S samples (sequences, or segments at
the high level), L steps of a sequence.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import optax
from jaxtyping import Array, Bool, Int

from envs_jax import EnvState, TimeStep

Key = jax.Array
Metrics = dict[str, Array]
Memory = Any
"""State of a policy between steps: any pytree with leading batch axes."""


class EnvCarry(NamedTuple):
    """State of E environment copies between two steps."""

    env_state: EnvState
    timestep: TimeStep
    """Current time step of the agents, after any auto-reset."""
    first: Bool[Array, " E"]
    """True where `timestep` begins an episode and memory from before must not be used."""


class Transition(NamedTuple):
    """One step of E copies. `unroll` stacks T of them in front."""

    timestep: TimeStep
    """Time step that the agents acted on."""
    first: Bool[Array, "*T E"]
    action: Int[Array, "*T E N"]
    extras: Any
    """Outputs that the policy keeps for the update: log-probabilities, values, memory."""
    outcome: TimeStep
    """Result of the action before any auto-reset: true last observation, reward, done."""


class Learner(NamedTuple):
    """Parameters with the state of their optimizer."""

    params: Any
    opt_state: optax.OptState


@runtime_checkable
class StepFn(Protocol):
    """Acting of a policy on a batch of any leading shape."""

    def __call__(
        self, memory: Memory, timestep: TimeStep, first: Bool[Array, "*batch"], key: Key
    ) -> tuple[Memory, Int[Array, "*batch N"], Any]:
        """Return the new memory, an action per agent, and extras (e.g. the skills in use)."""
        ...


class Policy(NamedTuple):
    """A trained joint policy as a pair of pure functions."""

    init: Callable[[tuple[int, ...]], Memory]
    """`init(batch_shape)`: memory before the first step."""
    step: StepFn


class Algorithm(NamedTuple):
    """A learning algorithm as three pure functions, all of which jit and vmap (over seeds)."""

    init: Callable[[Key], Any]
    """`init(key)`: the whole train state, one pytree."""
    update: Callable[[Any], tuple[Any, Metrics]]
    """`update(state)`: one rollout and all learning from it. Metrics are float scalars. Those of
    `rl.rollout.rollout_metrics` are among them."""
    policy: Callable[..., Policy]
    """`policy(state, greedy=True)`: act by arg-max (the paper's evaluation) or by sampling.

    An algorithm whose settings have `num_team_skills` and `num_skills` takes `skills` and
    `allowed`, too, as `hmasd.policy.make_policy` does. Reports and films hold skills by them."""
