"""The types that all algorithms share. NamedTuples hold arrays; frozen dataclasses hold settings.

Axes, by name: T rollout steps, E environment copies, N agents, M = T / k segments,
S sampled sequences, L steps of a sequence.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import optax
from jaxtyping import Array, Bool, Int

from envs_jax import EnvState, TimeStep

Key = jax.Array
Metrics = dict[str, Array]
Memory = Any
"""What a policy carries from step to step: any pytree with leading batch axes."""


class EnvCarry(NamedTuple):
    """Where E environment copies stand between two steps."""

    env_state: EnvState
    timestep: TimeStep
    """What the agents see now, after any auto-reset."""
    first: Bool[Array, " E"]
    """Whether `timestep` begins an episode: memory from before is not to be used."""


class Transition(NamedTuple):
    """One step of E copies. `unroll` stacks T of them in front."""

    timestep: TimeStep
    """What the agents saw when they acted."""
    first: Bool[Array, "*T E"]
    action: Int[Array, "*T E N"]
    extras: Any
    """What the policy wants kept: log-probabilities, values, memory."""
    outcome: TimeStep
    """What the action led to, before any auto-reset: true last observation, reward, done."""


class Learner(NamedTuple):
    """Parameters and the state of their optimizer."""

    params: Any
    opt_state: optax.OptState


class StepFn(Protocol):
    """Acts for a batch of any leading shape: `(memory, timestep, first, key)`."""

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
    """`init(key)`: the whole train state, one pytree. It has a field `num_updates`."""
    update: Callable[[Any], tuple[Any, Metrics]]
    """`update(state)`: one rollout and all learning from it; metrics are float scalars."""
    policy: Callable[..., Policy]
    """`policy(state, greedy=True)`: act by arg-max (the paper's evaluation) or by sampling."""
