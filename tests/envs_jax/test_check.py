"""`check_environment` accepts correct environments and names the fault of others."""

from dataclasses import dataclass, field
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from envs_jax import Environment, EnvironmentCheckError, check_environment
from envs_jax.probes import MatchCue, Probe

# "jaxmarl" has tests of its own, which need that package.
NAMES = [name for name in envs_jax.names() if name != "jaxmarl"]


@pytest.mark.parametrize("name", NAMES)
def test_registered_environments_pass(name):
    env = envs_jax.make(name)
    assert isinstance(env, Environment)
    check_environment(env)


def test_one_hot_alice_and_bob_passes():
    check_environment(envs_jax.make("alice_and_bob", observation="one_hot"), jax.random.key(1))


@pytest.mark.parametrize("name", NAMES)
def test_step_is_traced_once(name):
    env = envs_jax.make(name)
    traces = []

    @jax.jit
    def step(key, env_state, action):
        traces.append(name)
        return env.step(key, env_state, action)

    key = jax.random.key(0)
    env_state, _ = jax.eval_shape(env.reset, key)
    for _ in range(2):
        env_state, _ = step.eval_shape(key, env_state, jnp.zeros(env.num_agents, jnp.int32))
    assert len(traces) == 1


def broken(message, **members):
    """Make a test case of `MatchCue` with two steps and some members replaced."""
    members.setdefault("max_steps", 2)
    members["__annotations__"] = {"max_steps": int}
    name = "Broken"
    return pytest.param(
        dataclass(frozen=True)(type(name, (MatchCue,), members))(), message, id=message[:40]
    )


def emits(**changes):
    """Make a `_timestep` in which functions of the correct `TimeStep` replace some fields."""

    def _timestep(self, state, reward):
        right = Probe._timestep(self, state, reward)
        return right._replace(**{name: change(state, right) for name, change in changes.items()})

    return _timestep


def reset_with(**changes):
    def reset(self, key):
        env_state, timestep = Probe.reset(self, key)
        return env_state, timestep._replace(**changes)

    return reset


def step_to(change):
    """Make a `step` that applies `change` to its env_state."""

    def step(self, key, env_state, action):
        env_state, timestep = Probe.step(self, key, env_state, action)
        return change(env_state), timestep

    return step


def unbatched_only(state, timestep):
    """Return a state that is wrong only under vmap, which reverses the copies."""
    wrong = jax.custom_batching.custom_vmap(lambda x: x)
    wrong.def_vmap(lambda size, batched, x: (x[::-1], True))
    return wrong(timestep.state)


def under_jit(state, timestep):
    return timestep.state + isinstance(state.time, jax.core.Tracer)


@dataclass(frozen=True)
class WithList(MatchCue):
    layout: list = field(default_factory=list)


@dataclass
class NotFrozen:
    num_agents: ClassVar[int] = 2
    num_actions: ClassVar[int] = 2
    obs_dim: ClassVar[int] = 8
    state_dim: ClassVar[int] = 20
    max_steps: int = 1
    reset = step = render = Probe.reset


rng = np.random.default_rng(0)

CASES = [
    broken("num_actions must be an int above 0; found 0", num_actions=0),
    broken("obs_dim must be an int above 0; found 8.0", obs_dim=8.0),
    broken("it must have a method render; found None", render=None),
    pytest.param(
        NotFrozen(), "it must be a frozen dataclass; found a dataclass that is not", id="frozen"
    ),
    pytest.param(
        WithList(), "it must be hashable, so its fields must not hold arrays", id="hashable"
    ),
    broken("reset must return (env_state, TimeStep); found", reset=lambda self, key: (1, 2, 3)),
    broken(
        "step must run under jax.jit; found Attempted boolean conversion",
        _reward=lambda self, state: 1.0 if state.action[0] == 1 else 0.0,
    ),
    broken("obs of reset must be float32 (2, 9); found float32 (2, 8)", obs_dim=9),
    broken(
        "obs of reset must be float32 (2, 8); found int32 (2, 8)",
        _timestep=emits(obs=lambda state, right: right.obs.astype(jnp.int32)),
    ),
    broken(
        "reward of reset must be float32 (); found float32 (2,)",
        _timestep=emits(reward=lambda state, right: jnp.zeros(2)),
    ),
    broken(
        "terminated of step must be bool (); found int32 ()",
        step=lambda self, key, env_state, action: (
            env_state,
            Probe.step(self, key, env_state, action)[1]._replace(terminated=jnp.int32(1)),
        ),
    ),
    broken(
        "info of reset must be a dict with strings as keys; found ()",
        _timestep=emits(info=lambda state, right: ()),
    ),
    broken(
        "info of reset must not have env_steps, episodes, kind, length, return, seed, "
        "wall_seconds, which records have; found ['length']",
        _timestep=emits(info=lambda state, right: {"length": jnp.float32(0)}),
    ),
    broken("agent_colors must have 2 colors; found ((0, 0, 0),)", agent_colors=((0, 0, 0),)),
    broken(
        "info['success'] of reset must be a scalar; found int32 (2,)",
        _timestep=emits(info=lambda state, right: {"success": state.action}),
    ),
    broken(
        "info must have the same keys after a step as at reset, []; found ['success']",
        reset=reset_with(info={}),
    ),
    broken(
        "timestep.info['success'] of step must have the dtype and shape of reset, int32 ()",
        reset=reset_with(info={"success": np.int32(0)}),
    ),
    broken(
        "step must keep the structure of env_state, PyTreeDef",
        step=step_to(lambda env_state: tuple(env_state)),
    ),
    broken(
        "env_state.time of step must have the dtype and shape of reset, int32 (); found float32 ()",
        step=step_to(lambda env_state: env_state._replace(time=jnp.float32(1))),
    ),
    broken(
        "env_state.time of step must have a fixed dtype",
        step=step_to(lambda env_state: env_state._replace(time=2)),
    ),
    broken(
        "timestep.reward of reset must have a fixed dtype",
        reset=reset_with(reward=0.0),
    ),
    broken(
        "a second call with the same key must return the same as the first",
        _timestep=emits(state=lambda state, right: right.state + float(rng.random())),
    ),
    broken("jax.jit must not change the result", _timestep=emits(state=under_jit)),
    broken("jax.vmap must return the same as single calls", _timestep=emits(state=unbatched_only)),
    broken(
        "reward must be 0 or False at reset; found 1.0", reset=reset_with(reward=jnp.float32(1))
    ),
    broken(
        "truncated must be 0 or False at reset; found True",
        reset=reset_with(truncated=jnp.bool(True)),
    ),
    broken(
        "each agent must always have a legal action; found none at step 1 of an episode",
        _action_mask=lambda self, state: jnp.full((2, 2), state.time == 0),
    ),
    broken(
        "terminated and truncated must not be true together; found both at step 2",
        _timestep=emits(truncated=lambda state, right: right.terminated),
    ),
    broken(
        "timestep.obs must be finite; found nan or infinity at step 1",
        _timestep=emits(obs=lambda state, right: right.obs / (state.time != 1)),
    ),
    broken(
        "every episode must end (terminated or truncated) by step 2; found 16 of 16",
        _timestep=emits(terminated=lambda state, right: state.time > 2),
    ),
    broken(
        "render must return a NumPy uint8 image (height, width, 3); found float64 (4, 4, 3)",
        render=lambda self, env_state: np.zeros((4, 4, 3)),
    ),
    broken("uint8 image (height, width, 3); found list", render=lambda self, env_state: [[0]]),
]


@pytest.mark.parametrize(("env", "message"), CASES)
def test_broken_environments_are_reported(env, message):
    with pytest.raises(EnvironmentCheckError) as error:
        check_environment(env)
    text = str(error.value)
    assert text.startswith(type(env).__name__ + ": ")
    assert message in text


def test_fewer_steps_leave_the_time_limit_unchecked():
    env = CASES[-3].values[0]  # Its episodes do not end in time.
    check_environment(env, num_steps=1)
