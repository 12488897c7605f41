"""Imitation of a policy's own successes (self-imitation learning, Oh et al., ICML 2018).

A ring buffer keeps sequences that led to reward. After each update of PPO the actor takes a few
gradient steps towards the stored actions. The critic has no gradient then, but Adam goes on moving
it by its momentum. The actions are weighted by the discounted reward that followed. The weights are
averaged over the whole buffer, so that one lucky rollout in an empty buffer pulls little.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from envs_jax import Environment
from hmasd_jax.networks.actor_critic import ActorCritic, SequenceBatch
from hmasd_jax.rl.gae import reward_to_go
from hmasd_jax.rl.ppo import PPOConfig, has_choice
from hmasd_jax.rl.rollout import cut
from hmasd_jax.rl.sgd import gradient_step
from hmasd_jax.types import Key, Learner, Metrics, Transition
from hmasd_jax.validation import check_range, check_types


@dataclass(frozen=True)
class ImitationConfig:
    """Settings of imitation."""

    coef: float = 0.0
    """Weight of the imitation loss. With 0 nothing is stored."""
    steps: int = 2
    """Gradient steps per rollout, each on the whole buffer."""
    capacity: int = 256
    """Sequences in the buffer. New ones replace the oldest."""
    inserts: int = 48
    """Most sequences stored per rollout, drawn in proportion to the reward that follows them."""
    greedy_copies: int = 0
    """Copies of the environment that take the most likely actions and skills in training. They fill
    the buffer, if there is one, and train the critic of the actions. The coordinator learns nothing
    from them. The policy gradient of the actions takes only their worst ones, once play that
    samples succeeds (`greedy_copies.blame_greedy`)."""

    @property
    def steps_per_update(self) -> int:
        """Gradient steps per rollout, once something is stored."""
        return self.steps if self.coef else 0

    def __post_init__(self) -> None:
        check_types(self)
        check_range(self, "coef", low=0)
        check_range(self, "steps", "capacity", low=1)
        # With more, two sequences of one rollout would go to the same slot.
        check_range(self, "inserts", low=1, high=self.capacity)
        check_range(self, "greedy_copies", low=0)

    def check_copies(self, num_envs: int) -> None:
        """Raise an error unless some of `num_envs` copies are left to explore."""
        if self.greedy_copies >= num_envs:
            raise ValueError(
                f"imitation.greedy_copies must be less than ppo.num_envs = {num_envs}, got "
                f"{self.greedy_copies}"
            )


class StoredSteps(NamedTuple):
    """Inputs and actions of C sequences."""

    first: Bool[Array, "C L"]
    obs: Float[Array, "C L N obs"]
    action_mask: Bool[Array, "C L N actions"]
    skills: Int[Array, "C L N"] | None
    """z^1..z^N, where there are skills."""
    action: Int[Array, "C L N"]


class Successes(NamedTuple):
    """Ring buffer of C sequences."""

    memory: Float[Array, "C N hidden"]
    """Memory of the actor before each sequence."""
    steps: StoredSteps
    weight: Float[Array, "C L"]
    """Discounted reward that followed, 1 for the largest of its rollout; 0 in an empty slot."""
    next_slot: Int[Array, ""]


class Imitation(NamedTuple):
    """Imitation as three pure functions."""

    init: Callable[[], Any]
    """`init()`: empty buffer."""
    store: Callable[[Any, SequenceBatch, Transition, Key], tuple[Any, Metrics]]
    """`store(successes, batch, transitions, key)`: keep the successes of a rollout."""
    train: Callable[[Any, Learner, optax.GradientTransformation], tuple[Learner, Metrics]]
    """`train(successes, learner, optimizer)`: take gradient steps towards what is stored, which
    the optimizer counts beside those of PPO."""


NO_IMITATION = Imitation(
    init=lambda: (),
    store=lambda successes, batch, transitions, key: (successes, {}),
    train=lambda successes, learner, optimizer: (learner, {}),
)


def make_imitation(
    env: Environment,
    networks: ActorCritic,
    config: ImitationConfig,
    ppo: PPOConfig,
    has_skills: bool,
) -> Imitation:
    """Build imitation for an actor of `env`.

    Args:
        env: environment.
        networks: actor and critic. The actor imitates.
        config: settings.
        ppo: lengths, sizes and discount.
        has_skills: if True, the actor depends on skills.
    """
    if config.coef == 0:
        return NO_IMITATION

    def init() -> Successes:
        return empty_buffer(env, config, ppo, has_skills)

    def store(successes: Successes, batch: SequenceBatch, transitions: Transition, key: Key):
        outcome = transitions.outcome
        to_come = reward_to_go(outcome.reward, outcome.done, ppo.discount)
        return insert(successes, batch, cut(to_come, ppo.sequence_length), config.inserts, key)

    def train(successes: Successes, learner: Learner, optimizer: optax.GradientTransformation):
        def step(learner, _):
            return gradient_step(learner, optimizer, loss, successes)

        def steps(learner):
            learner, metrics = jax.lax.scan(step, learner, None, length=config.steps)
            return learner, metrics["imitation_loss"].mean()

        def loss(params, successes):
            value = config.coef * imitation_loss(params, networks, successes)
            return value, {"imitation_loss": value}

        # With nothing stored Adam would still move the parameters by its momentum.
        is_empty = (successes.weight == 0).all()
        learner, value = jax.lax.cond(is_empty, lambda x: (x, jnp.float32(0)), steps, learner)
        return learner, {"imitation_loss": value}

    return Imitation(init, store, train)


def empty_buffer(
    env: Environment, config: ImitationConfig, ppo: PPOConfig, has_skills: bool
) -> Successes:
    """Return a buffer without sequences."""
    sequences = (config.capacity, ppo.sequence_length)
    agents = (*sequences, env.num_agents)
    return Successes(
        memory=jnp.zeros((config.capacity, env.num_agents, ppo.hidden_size)),
        steps=StoredSteps(
            first=jnp.zeros(sequences, bool),
            obs=jnp.zeros((*agents, env.obs_dim)),
            action_mask=jnp.ones((*agents, env.num_actions), bool),
            skills=jnp.zeros(agents, int) if has_skills else None,
            action=jnp.zeros(agents, int),
        ),
        weight=jnp.zeros(sequences),
        next_slot=jnp.int32(0),
    )


def insert(
    successes: Successes, batch: SequenceBatch, to_come: Float[Array, "S L"], most: int, key: Key
) -> tuple[Successes, Metrics]:
    """Store the sequences of a rollout that led to reward, at most `most` of them.

    Args:
        successes: buffer.
        batch: sequences of the rollout.
        to_come: discounted rewards that follow each step. Negative ones count as none.
        most: most sequences to store, drawn in proportion to their largest weight.
        key: PRNG key of the draw.

    Returns:
        The new buffer, and the number of sequences stored.
    """
    weight = jnp.maximum(to_come, 0.0)
    weight = weight / jnp.maximum(weight.max(), 1e-6)
    best = weight.max(-1)
    # The largest of log w + Gumbel noise are a draw without replacement. The sequences with the
    # most reward alone would be the ends of episodes, and a policy that has lost the way to them
    # could not find it in the buffer.
    score = jnp.log(best) + jax.random.gumbel(key, best.shape)
    score, chosen = jax.lax.top_k(score, min(most, len(best)))
    is_success = score > -jnp.inf
    capacity = len(successes.weight)
    # Others get a slot out of range, which `mode="drop"` ignores.
    slot = (successes.next_slot + jnp.cumsum(is_success) - 1) % capacity
    slot = jnp.where(is_success, slot, capacity)
    steps = StoredSteps(
        first=batch.first,
        obs=batch.obs,
        action_mask=batch.action_mask,
        skills=None if batch.skills is None else batch.skills[..., 1:],
        action=batch.action,
    )
    memory, steps, weight = jax.tree.map(
        lambda old, new: old.at[slot].set(new[chosen], mode="drop"),
        (successes.memory, successes.steps, successes.weight),
        (batch.memory.actor, steps, weight),
    )
    count = is_success.sum()
    next_slot = (successes.next_slot + count) % capacity
    stored = Successes(memory=memory, steps=steps, weight=weight, next_slot=next_slot)
    return stored, {"stored_successes": count.astype(jnp.float32)}


def imitation_loss(params: dict, networks: ActorCritic, successes: Successes) -> Float[Array, ""]:
    """Return -log pi(a|o, z) of the stored actions, weighted, averaged over the whole buffer."""
    # (C, L, ...) -> (L, C, ...): recurrent networks run over the first axis.
    steps, weight = jax.tree.map(lambda x: x.swapaxes(0, 1), (successes.steps, successes.weight))
    _, distribution = networks.act(
        params, successes.memory, steps.obs, steps.action_mask, steps.first, steps.skills
    )
    log_prob = jnp.asarray(distribution.log_prob(steps.action))
    active = has_choice(steps.action_mask)
    return -(jnp.where(active, log_prob, 0.0) * weight[..., None]).mean()
