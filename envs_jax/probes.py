"""Probes: tiny tasks with known answers, each of which tests one part of a learner.

The idea is that of andyljones.com/rl-debugging, extended to cooperating agents and two levels. When
training goes wrong, try the probes in the order of this file: each needs everything that the
earlier ones test, and one thing more. All have two agents and two actions.

Train on the team reward alone (in HMASD: `extrinsic_coef=1` and both intrinsic coefficients 0). The
last two probes need skills: train them as HMASD does by default, with intrinsic rewards for the low
level and the team reward for the high level.

An agent observes four pairs of indicators: its cue, its own index, its last action, and whether
the episode is at its first or at its last step. A pair is (0, 0) if the probe hides this fact.
Facts are pairs instead of numbers because a network that begins with a LayerNorm does not see the
scale of its input. The global state contains both observations, then both cues, hidden or not.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs_jax.choices import check_whole
from envs_jax.types import TimeStep

NO_ACTION = -1


class ProbeState(NamedTuple):
    """Simulator state of a probe."""

    cue: Int[Array, "*batch 2"]
    """Cue of each agent, 0 or 1, drawn at reset."""
    action: Int[Array, "*batch 2"]
    """Last action of each agent; -1 at reset."""
    time: Int[Array, "*batch"]
    """Steps taken."""


@dataclass(frozen=True)
class Probe:
    """Base class of the probes. A subclass defines the cue, the reward and the hidden facts.

    Raises:
        ValueError: `max_steps` is below `min_steps`.
    """

    max_steps: int = 1
    """Length of every episode in environment steps."""

    num_agents: ClassVar[int] = 2
    num_actions: ClassVar[int] = 2
    obs_dim: ClassVar[int] = 8
    state_dim: ClassVar[int] = 2 * 8 + 2 * 2
    min_steps: ClassVar[int] = 1
    """Length below which the probe makes no sense."""
    shows_index: ClassVar[bool] = True
    """If True, agents observe their own index."""
    ends_by_time_limit: ClassVar[bool] = False
    """If True, the end of an episode is `truncated` instead of `terminated`."""

    def __post_init__(self) -> None:
        check_whole("max_steps", self.max_steps, self.min_steps)

    def reset(self, key: jax.Array) -> tuple[ProbeState, TimeStep]:
        """Start an episode with newly drawn cues."""
        state = ProbeState(
            cue=self._cue(key), action=jnp.full(2, NO_ACTION, jnp.int32), time=jnp.int32(0)
        )
        return state, self._timestep(state, jnp.float32(0))

    def step(
        self, key: jax.Array, env_state: ProbeState, action: Int[Array, " agents"]
    ) -> tuple[ProbeState, TimeStep]:
        """Advance one step and reward `action`. `key` is not used."""
        del key
        state = ProbeState(
            cue=env_state.cue, action=action.astype(jnp.int32), time=env_state.time + 1
        )
        return state, self._timestep(state, jnp.float32(self._reward(state)))

    def render(self, env_state: ProbeState) -> np.ndarray:
        """Draw cue and last action (dark 0, light 1) in a row per agent, and a bar for the time."""
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
        action = jax.nn.one_hot(state.action, 2)  # Zeros at reset, for -1.
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
        """Return the team reward of the step that led to `state`."""
        raise NotImplementedError


@dataclass(frozen=True)
class ConstantReward(Probe):
    """One step with reward 1. Answer: value 1.

    Failure points to the value loss, its targets, the value normalizer or the critic's optimizer.
    """

    def _reward(self, state: ProbeState) -> float:
        return 1.0


@dataclass(frozen=True)
class ObservedReward(Probe):
    """One step with reward +1 if the common cue is 1, else -1. Answer: value = reward.

    Failure after success at `ConstantReward` means that the critic does not see the state it is
    trained for: batching mixes up copies or steps, or the memory is not reset.
    """

    def _cue(self, key: jax.Array) -> Int[Array, "2"]:
        return jnp.full(2, jax.random.bernoulli(key), jnp.int32)

    def _reward(self, state: ProbeState) -> Array:
        return 2 * state.cue[0] - 1


@dataclass(frozen=True)
class DelayedReward(Probe):
    """Reward 1 at the last step only.

    Answer: value discount^(max_steps - 1 - time), so 1 at the last step.
    Failure points to discounting, to advantage estimation, or to a `done` shifted by one step.
    """

    max_steps: int = 2
    min_steps: ClassVar[int] = 2

    def _reward(self, state: ProbeState) -> Array:
        return state.time == self.max_steps


@dataclass(frozen=True)
class TimeLimit(Probe):
    """Reward 1 at every step until the time limit cuts the episode.

    Answer: value 1 / (1 - discount) at every step if the learner bootstraps at time limits, and
    1 + discount + ..., one term per step left, if it treats them as the end.
    Failure means that `truncated` and `terminated` are confused, or that the learner bootstraps
    from the first state of the next episode.
    """

    max_steps: int = 2
    ends_by_time_limit: ClassVar[bool] = True

    def _reward(self, state: ProbeState) -> float:
        return 1.0


@dataclass(frozen=True)
class LegalAction(Probe):
    """One step with one random legal action per agent. Answer: return 1 without learning.

    Failure means that the action mask does not reach the policy, in acting or in training.
    """

    def _cue(self, key: jax.Array) -> Int[Array, "2"]:
        return _coins(key)

    def _action_mask(self, state: ProbeState) -> Bool[Array, "2 2"]:
        return jnp.arange(2) == state.cue[:, None]

    def _reward(self, state: ProbeState) -> Array:
        return (state.action == state.cue).mean()


@dataclass(frozen=True)
class OwnAction(Probe):
    """One step that rewards agent i for action i. Answer: return 1; random actions return 1/2.

    Failure points to the sign or the clipping of the policy loss, or to mixed-up agents.
    """

    def _reward(self, state: ProbeState) -> Array:
        return (state.action == np.arange(2)).mean()


@dataclass(frozen=True)
class MatchCue(Probe):
    """One step that rewards each agent for the action equal to its cue.

    Answer: return 1; random actions return 1/2.
    Failure after success at `OwnAction` means that the loss combines actions, observations and
    advantages of different copies, agents or steps.
    """

    def _cue(self, key: jax.Array) -> Int[Array, "2"]:
        return _coins(key)

    def _reward(self, state: ProbeState) -> Array:
        return (state.action == state.cue).mean()


@dataclass(frozen=True)
class RememberCue(MatchCue):
    """`MatchCue` with the cue shown at the first step and rewarded at the last.

    Answer: return 1; without memory 1/2.
    Failure means that the recurrent memory is lost between steps, is not reset between episodes, or
    starts from a different carry in training than it did in acting.
    """

    max_steps: int = 5
    min_steps: ClassVar[int] = 2

    def _shows_cue(self, state: ProbeState) -> Bool[Array, ""]:
        return state.time == 0

    def _reward(self, state: ProbeState) -> Array:
        return super()._reward(state) * (state.time == self.max_steps)


@dataclass(frozen=True)
class HiddenCue(MatchCue):
    """`MatchCue` for several steps, with cues that only the global state shows.

    Answer: reward 1 per step if a coordinator that sees the state instructs the agents, else 1/2.
    Failure means that skills do not depend on the state, or actions do not depend on skills.
    """

    max_steps: int = 4

    def _shows_cue(self, state: ProbeState) -> bool:
        return False


@dataclass(frozen=True)
class DifferentActions(Probe):
    """Reward 1 per step if the agents, whose observations are equal, choose different actions.

    Answer: reward 1 per step if skills are assigned one after the other. Independent agents with
    equal policies get at most 1/2, and so does a coordinator that draws skills independently.
    Failure means that skill i does not depend on the skills before it.
    """

    max_steps: int = 4
    shows_index: ClassVar[bool] = False

    def _reward(self, state: ProbeState) -> Array:
        return state.action[0] != state.action[1]


def _coins(key: jax.Array) -> Int[Array, "2"]:
    """Toss an independent fair coin for each agent."""
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
