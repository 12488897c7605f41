"""Probes: tiny tasks with known answers, each of which fails for one reason.

After andyljones.com/rl-debugging, for cooperating agents and two levels. When training goes wrong
try them in the order of this file: each needs what those before it test, and one thing more. All
have two agents and two actions; learn from the team reward alone (in HMASD: `extrinsic_coef=1`,
both intrinsic coefficients 0), but the last two, which need skills, as HMASD does by default: the
low level from intrinsic rewards, the high level from the team reward.

An agent observes four pairs of indicators: its cue, its own index, its last action, and whether
the episode is at its first or at its last step. A pair is (0, 0) where a probe hides that fact.
Facts are pairs, not numbers, because networks that begin with a LayerNorm do not see an input's
scale. The global state is both observations and then both cues, hidden or not.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs_jax.types import TimeStep

NO_ACTION = -1


class ProbeState(NamedTuple):
    """Simulator state of all probes."""

    cue: Int[Array, "*batch 2"]
    """What the episode is about, 0 or 1 for each agent."""
    action: Int[Array, "*batch 2"]
    """Last action of each agent, -1 at reset."""
    time: Int[Array, "*batch"]
    """Steps taken."""


@dataclass(frozen=True)
class Probe:
    """What the probes share; a probe overrides its cue, its reward and what it hides.

    Raises:
        ValueError: `max_steps` is below the least that the probe makes sense with.
    """

    max_steps: int = 1
    """Length of every episode in environment steps."""

    num_agents: ClassVar[int] = 2
    num_actions: ClassVar[int] = 2
    obs_dim: ClassVar[int] = 8
    state_dim: ClassVar[int] = 2 * 8 + 2 * 2
    min_steps: ClassVar[int] = 1
    shows_index: ClassVar[bool] = True
    ends_by_time_limit: ClassVar[bool] = False
    """Whether the end is `truncated` rather than `terminated`."""

    def __post_init__(self) -> None:
        if self.max_steps < self.min_steps:
            raise ValueError(f"max_steps must be at least {self.min_steps}, got {self.max_steps}")

    def reset(self, key: jax.Array) -> tuple[ProbeState, TimeStep]:
        """Draw the cues."""
        state = ProbeState(self._cue(key), jnp.full(2, NO_ACTION, jnp.int32), jnp.int32(0))
        return state, self._timestep(state, jnp.float32(0))

    def step(
        self, key: jax.Array, env_state: ProbeState, action: Int[Array, " agents"]
    ) -> tuple[ProbeState, TimeStep]:
        """Pay for `action`. `key` is not used."""
        del key
        state = ProbeState(env_state.cue, action.astype(jnp.int32), env_state.time + 1)
        return state, self._timestep(state, jnp.float32(self._reward(state)))

    def render(self, env_state: ProbeState) -> np.ndarray:
        """Draw a row per agent: cue and last action, dark for 0 and light for 1, then the time."""
        scale, shades = 24, np.array([(70, 70, 90), (235, 200, 90), (160, 160, 160)], np.uint8)
        facts = np.stack([np.asarray(env_state.cue), np.asarray(env_state.action)], axis=1)
        image = shades[facts].repeat(scale, 0).repeat(scale, 1)
        bar = np.zeros((scale // 4, image.shape[1], 3), np.uint8)
        bar[:, : int(image.shape[1] * env_state.time / self.max_steps)] = 255
        return np.concatenate([image, bar])

    def _timestep(self, state: ProbeState, reward: Float[Array, ""]) -> TimeStep:
        over = state.time >= self.max_steps
        obs = self._observe(state)
        cues = jax.nn.one_hot(state.cue, 2)
        return TimeStep(
            obs=obs,
            state=jnp.concatenate([obs.ravel(), cues.ravel()]),
            action_mask=self._action_mask(state),
            reward=reward,
            terminated=over & (not self.ends_by_time_limit),
            truncated=over & self.ends_by_time_limit,
            info={"success": (reward == 1).astype(jnp.float32)},
        )

    def _observe(self, state: ProbeState) -> Float[Array, "2 8"]:
        cue = jax.nn.one_hot(state.cue, 2) * self._shows_cue(state)
        index = jnp.eye(2) * self.shows_index
        action = jax.nn.one_hot(state.action, 2)  # of -1: zeros
        phase = jnp.stack([state.time == 0, state.time == self.max_steps - 1])
        return jnp.concatenate([cue, index, action, jnp.tile(phase, (2, 1))], axis=1)

    def _cue(self, key: jax.Array) -> Int[Array, "2"]:
        del key
        return jnp.zeros(2, jnp.int32)

    def _shows_cue(self, state: ProbeState) -> Bool[Array, ""] | bool:
        del state
        return True

    def _action_mask(self, state: ProbeState) -> Bool[Array, "2 2"]:
        del state
        return jnp.ones((2, 2), bool)

    def _reward(self, state: ProbeState) -> Array | float:
        """Team reward of the step that led to `state`."""
        raise NotImplementedError


@dataclass(frozen=True)
class ConstantReward(Probe):
    """One step, reward 1. Answer: value 1.

    Failure: the value loss, its targets, the value normalizer or the critic's optimizer.
    """

    def _reward(self, state: ProbeState) -> float:
        return 1.0


@dataclass(frozen=True)
class ObservedReward(Probe):
    """One step, reward +1 or -1 as the common cue says. Answer: value = cue.

    Failure, if `ConstantReward` works: the critic does not see the state it is trained for
    (copies or steps mixed up when batching, memory not reset).
    """

    def _cue(self, key: jax.Array) -> Int[Array, "2"]:
        return jnp.full(2, jax.random.bernoulli(key), jnp.int32)

    def _reward(self, state: ProbeState) -> Array:
        return 2 * state.cue[0] - 1


@dataclass(frozen=True)
class DelayedReward(Probe):
    """Reward 1 at the last step only. Answer: value discount^(steps to come), at last 1.

    Failure: discounting, advantage estimation, or `done` shifted by one step.
    """

    max_steps: int = 2
    min_steps: ClassVar[int] = 2

    def _reward(self, state: ProbeState) -> Array:
        return state.time == self.max_steps


@dataclass(frozen=True)
class TimeLimit(Probe):
    """Reward 1 at every step until the time limit cuts the episode.

    Answer: value 1 / (1 - discount) at every step if time limits are bootstrapped from, and
    1 + discount + .. over the steps to come if they count as the end.
    Failure: `truncated` taken for `terminated` or the reverse, or a bootstrap from the next
    episode's first state.
    """

    max_steps: int = 2
    ends_by_time_limit: ClassVar[bool] = True

    def _reward(self, state: ProbeState) -> float:
        return 1.0


@dataclass(frozen=True)
class LegalAction(Probe):
    """One step; each agent has one legal action, drawn anew. Answer: return 1 without learning.

    Failure: the action mask does not reach the policy, when acting or when training.
    """

    def _cue(self, key: jax.Array) -> Int[Array, "2"]:
        return _coins(key)

    def _action_mask(self, state: ProbeState) -> Bool[Array, "2 2"]:
        return jnp.arange(2) == state.cue[:, None]

    def _reward(self, state: ProbeState) -> Array:
        return (state.action == state.cue).mean()


@dataclass(frozen=True)
class OwnAction(Probe):
    """One step; agent i is paid for action i. Answer: return 1, at random 1/2.

    Failure: the sign or the clipping of the policy loss, or agents mixed up.
    """

    def _reward(self, state: ProbeState) -> Array:
        return (state.action == np.arange(2)).mean()


@dataclass(frozen=True)
class MatchCue(Probe):
    """One step; each agent is paid for naming its own cue. Answer: return 1, at random 1/2.

    Failure, if `OwnAction` works: actions, observations and advantages of different copies,
    agents or steps meet in the loss.
    """

    def _cue(self, key: jax.Array) -> Int[Array, "2"]:
        return _coins(key)

    def _reward(self, state: ProbeState) -> Array:
        return (state.action == state.cue).mean()


@dataclass(frozen=True)
class RememberCue(Probe):
    """As `MatchCue`, but the cue is shown at the first step and asked for at the last.

    Answer: return 1, without memory 1/2.
    Failure: the recurrent memory is lost between steps, not reset between episodes, or replayed
    in training from another beginning than it had when acting.
    """

    max_steps: int = 5
    min_steps: ClassVar[int] = 2

    def _cue(self, key: jax.Array) -> Int[Array, "2"]:
        return _coins(key)

    def _shows_cue(self, state: ProbeState) -> Bool[Array, ""]:
        return state.time == 0

    def _reward(self, state: ProbeState) -> Array:
        return (state.action == state.cue).mean() * (state.time == self.max_steps)


@dataclass(frozen=True)
class HiddenCue(Probe):
    """As `MatchCue`, but only the global state shows the cues.

    Answer: return 1 if something that sees the state (a coordinator) tells the agents what to do,
    else 1/2.
    Failure: skills do not depend on the state, or actions do not depend on skills.
    """

    max_steps: int = 4

    def _cue(self, key: jax.Array) -> Int[Array, "2"]:
        return _coins(key)

    def _shows_cue(self, state: ProbeState) -> bool:
        return False

    def _reward(self, state: ProbeState) -> Array:
        return (state.action == state.cue).mean()


@dataclass(frozen=True)
class DifferentActions(Probe):
    """Every step pays 1 if the agents, which nothing tells apart, choose different actions.

    Answer: 1 a step if roles are assigned one after the other. Agents that act alike but
    independently get at most 1/2, and so does a coordinator that draws skills independently.
    Failure: skill i does not depend on the skills before it.
    """

    max_steps: int = 4
    shows_index: ClassVar[bool] = False

    def _reward(self, state: ProbeState) -> Array:
        return state.action[0] != state.action[1]


def _coins(key: jax.Array) -> Int[Array, "2"]:
    """An independent fair coin for each agent."""
    return jax.random.bernoulli(key, shape=(2,)).astype(jnp.int32)


PROBES: dict[str, type[Probe]] = {
    "probe_constant_reward": ConstantReward,
    "probe_observed_reward": ObservedReward,
    "probe_delayed_reward": DelayedReward,
    "probe_time_limit": TimeLimit,
    "probe_legal_action": LegalAction,
    "probe_own_action": OwnAction,
    "probe_match_cue": MatchCue,
    "probe_remember_cue": RememberCue,
    "probe_hidden_cue": HiddenCue,
    "probe_different_actions": DifferentActions,
}
