"""What an environment is: pure functions over arrays.

Axes: an environment is unbatched; `jax.vmap` adds the copies axis E in front. `agents`,
`actions`, `obs` and `state` are the environment's `num_agents`, `num_actions`, `obs_dim`
and `state_dim`.
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

EnvState = Any
"""The simulator's own state: any pytree of arrays. Not the Dec-POMDP's global state."""


class TimeStep(NamedTuple):
    """What an environment emits at `reset` and after every `step`."""

    obs: Float[Array, "*batch agents obs"]
    """Each agent's own observation o^i."""
    state: Float[Array, "*batch state"]
    """Global state s of the Dec-POMDP, for centralized critics and coordinators."""
    action_mask: Bool[Array, "*batch agents actions"]
    """True where an action is legal. Every agent always has at least one legal action."""
    reward: Float[Array, "*batch"]
    """Team reward of the step that led here; 0 at reset."""
    terminated: Bool[Array, "*batch"]
    """The task itself ended here (value of what follows is 0). False at reset."""
    truncated: Bool[Array, "*batch"]
    """The time limit cut the episode here. Never true together with `terminated`."""
    info: dict[str, Array]
    """Scalars with fixed keys, e.g. `success`; as final values of the episode when it ends."""

    @property
    def done(self) -> Bool[Array, "*batch"]:
        """The episode is over, for either reason."""
        return self.terminated | self.truncated


@runtime_checkable
class Environment(Protocol):
    """A cooperative multi-agent task, as a frozen dataclass whose fields are its configuration.

    An environment is hashable, holds no arrays and never resets itself: auto-reset belongs to
    the rollout. `envs_jax.check_environment` tests everything promised here.
    """

    @property
    def num_agents(self) -> int:
        """Number of agents N."""
        ...

    @property
    def num_actions(self) -> int:
        """Number of discrete actions, the same for all agents."""
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
        """Time limit: every episode is over after this many steps."""
        ...

    def reset(self, key: jax.Array) -> tuple[EnvState, TimeStep]:
        """Start an episode from randomness `key`."""
        ...

    def step(
        self, key: jax.Array, env_state: EnvState, action: Int[Array, " agents"]
    ) -> tuple[EnvState, TimeStep]:
        """Advance one step with one action index per agent."""
        ...

    def render(self, env_state: EnvState) -> np.ndarray:
        """Draw one unbatched `env_state` as a uint8 image (height, width, 3). Host side only."""
        ...
