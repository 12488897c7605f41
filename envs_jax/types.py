"""Interface of an environment: pure functions over arrays.

Axes: an environment is unbatched, and `jax.vmap` adds the axis E of environment copies in front.
`agents`, `actions`, `obs` and `state` are the environment's `num_agents`, `num_actions`, `obs_dim`
and `state_dim`.
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

EnvState = Any
"""State of the simulator: any pytree of arrays. It is not the Dec-POMDP's global state."""


class TimeStep(NamedTuple):
    """Output of an environment at `reset` and after every `step`."""

    obs: Float[Array, "*batch agents obs"]
    """Observation o^i of each agent."""
    state: Float[Array, "*batch state"]
    """Global state s of the Dec-POMDP, for centralized critics and coordinators."""
    action_mask: Bool[Array, "*batch agents actions"]
    """True where an action is legal. Every agent always has at least one legal action."""
    reward: Float[Array, "*batch"]
    """Team reward of the step that led here; 0 at reset."""
    terminated: Bool[Array, "*batch"]
    """True if the task itself ended here, so that later values are 0. False at reset."""
    truncated: Bool[Array, "*batch"]
    """True if the time limit cut the episode here. Never true together with `terminated`."""
    info: dict[str, Array]
    """Scalars with fixed keys, e.g. `success`. Those of the last step describe the episode."""

    @property
    def done(self) -> Bool[Array, "*batch"]:
        """True if the episode is over, for either reason."""
        return self.terminated | self.truncated


@runtime_checkable
class Environment(Protocol):
    """Cooperative multi-agent task: a frozen dataclass whose fields are its configuration.

    An environment is hashable and holds no arrays. It never resets itself, because auto-reset
    belongs to the rollout. `envs_jax.check_environment` tests these properties.
    """

    @property
    def num_agents(self) -> int:
        """Number of agents N."""
        ...

    @property
    def num_actions(self) -> int:
        """Number of discrete actions, equal for all agents."""
        ...

    @property
    def obs_dim(self) -> int:
        """Length of one agent's observation vector."""
        ...

    @property
    def state_dim(self) -> int:
        """Length of the global state vector."""
        ...

    @property
    def max_steps(self) -> int:
        """Time limit of an episode in environment steps."""
        ...

    def reset(self, key: jax.Array) -> tuple[EnvState, TimeStep]:
        """Start an episode that is drawn with `key`."""
        ...

    def step(
        self, key: jax.Array, env_state: EnvState, action: Int[Array, " agents"]
    ) -> tuple[EnvState, TimeStep]:
        """Advance one step with one action index per agent."""
        ...

    def render(self, env_state: EnvState) -> np.ndarray:
        """Draw one unbatched `env_state` as a uint8 image (height, width, 3), on the host."""
        ...
