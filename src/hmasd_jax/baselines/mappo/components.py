"""Settings and static parts of MAPPO, which IPPO and EITI build on."""

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from envs_jax import Environment, TimeStep
from hmasd_jax.exploration.bonus import Bonus, add
from hmasd_jax.exploration.frontier import make_frontier
from hmasd_jax.exploration.frontier_config import FrontierConfig
from hmasd_jax.exploration.novelty import NoveltyConfig, make_novelty
from hmasd_jax.exploration.solved import SolvedConfig, check_solved
from hmasd_jax.exploration.successes import Imitation, ImitationConfig, make_imitation
from hmasd_jax.networks.actor_critic import NETWORKS, ActorCritic, ActorCriticMemory
from hmasd_jax.networks.recurrent import SMALL_GAIN, FeedForwardNet, RecurrentNet
from hmasd_jax.rl.ppo import PPOConfig, has_choice
from hmasd_jax.rl.sgd import make_optimizer
from hmasd_jax.validation import check_range, check_types


@dataclass(frozen=True)
class MAPPOConfig:
    """Settings of MAPPO. The defaults are the paper's: on-policy's `rmappo`."""

    entropy_coef: float = 0.01
    """Weight of the policy's entropy."""
    recurrent: bool = True
    """If True, actor and critic have a memory (on-policy's `rmappo`), else none (`mappo`)."""
    critic_input: Literal["state", "agent", "obs"] = "state"
    """Input of the critic. `state`: the global state, for one value of all agents. `agent`: the
    state, the agent's observation and its index, for a value per agent. `obs`: the agent's
    observation alone, for a value per agent."""
    death_masking: bool = True
    """If True, with `critic_input` "agent", the critic sees only the index of an agent that has no
    choice of actions, such as the dead."""
    novelty: NoveltyConfig = field(default_factory=NoveltyConfig)
    """Bonus for states not seen before, in units of the team reward. The paper has none."""
    frontier: FrontierConfig = field(default_factory=FrontierConfig)
    """Bonus for values of single features that few episodes reach, in units of the team reward. The
    paper has none."""
    imitation: ImitationConfig = field(default_factory=ImitationConfig)
    """Imitation of own successes. The paper has none."""
    solved: SolvedConfig = field(default_factory=SolvedConfig)
    """Changes once the task is solved. p is the chance that the episodes of all copies of
    the environment are solved. Needs the `frontier`. The paper has none."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Optimization settings."""

    def __post_init__(self) -> None:
        check_types(self)
        check_range(self, "entropy_coef", low=0)
        check_solved(self)
        self.ppo.check_sequences()
        self.imitation.check_copies(self.ppo.num_envs)


class Extras(NamedTuple):
    """Record of a step that the update needs."""

    memory: ActorCriticMemory
    """Memory before the step."""
    log_prob: Float[Array, "*T E N"]
    value: Float[Array, "*T E V"]
    """Values of the critic, in normalized units."""


@dataclass(frozen=True)
class Parts:
    """Static components that the pure functions of MAPPO take."""

    env: Environment
    config: MAPPOConfig
    networks: ActorCritic
    optimizer: optax.GradientTransformationExtraArgs
    bonus: Bonus
    imitation: Imitation

    @property
    def num_values(self) -> int:
        """V, the number of values per step."""
        return 1 if self.config.critic_input == "state" else self.env.num_agents


def make_parts(env: Environment, config: MAPPOConfig) -> Parts:
    """Build networks and optimizer. The gradients of actor and critic are clipped separately."""
    net = RecurrentNet if config.recurrent else FeedForwardNet
    size = config.ppo.hidden_size
    networks = ActorCritic(
        actor=net(env.num_actions, size, gain=SMALL_GAIN), critic=net(1, size, gain=1.0)
    )
    steps = config.ppo.steps_per_update + config.imitation.steps_per_update
    return Parts(
        env=env,
        config=config,
        networks=networks,
        optimizer=make_optimizer(config.ppo, NETWORKS, steps),
        bonus=add(
            make_novelty(env, config.novelty),
            make_frontier(env, config.frontier, config.ppo.num_envs),
        ),
        imitation=make_imitation(env, networks, config.imitation, config.ppo, has_skills=False),
    )


def init_memory(parts: Parts, batch_shape: tuple[int, ...]) -> ActorCriticMemory:
    """Return the memory before the first step."""
    size = parts.config.ppo.hidden_size
    return ActorCriticMemory(
        actor=jnp.zeros((*batch_shape, parts.env.num_agents, size)),
        critic=jnp.zeros((*batch_shape, parts.num_values, size)),
    )


def critic_input(config: MAPPOConfig, timestep: TimeStep) -> Float[Array, "*batch V state"]:
    """Return the critic's input for each of the V values."""
    state, obs = timestep.state[..., None, :], timestep.obs
    if config.critic_input == "state":
        return state
    if config.critic_input == "obs":
        return obs
    state = jnp.broadcast_to(state, (*obs.shape[:-1], state.shape[-1]))
    seen = jnp.concatenate([state, obs], axis=-1)
    if config.death_masking:
        seen = jnp.where(has_choice(timestep.action_mask)[..., None], seen, 0.0)
    num_agents = obs.shape[-2]
    index = jnp.broadcast_to(jnp.eye(num_agents), (*obs.shape[:-1], num_agents))
    return jnp.concatenate([seen, index], axis=-1)
