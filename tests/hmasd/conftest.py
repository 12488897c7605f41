"""One tiny HMASD, compiled once: episodes of 7 steps end inside its sequences of 5."""

import chex
import jax
import pytest

from envs_jax.alice_and_bob import AliceAndBob
from hmasd_jax.hmasd.algorithm import make_hmasd
from hmasd_jax.hmasd.components import make_parts
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.rollout_phase import collect
from hmasd_jax.rl.ppo import PPOConfig

ENV = AliceAndBob(max_steps=7)
CONFIG = HMASDConfig(
    skill_interval=5,
    num_team_skills=2,
    num_skills=3,
    discriminator_epochs=2,
    ppo=PPOConfig(
        num_envs=4,
        rollout_length=20,
        sequence_length=5,
        num_epochs=1,
        learning_rate=1e-2,
        hidden_size=8,
    ),
)


@pytest.fixture(scope="session")
def config():
    return CONFIG


@pytest.fixture(scope="session")
def parts():
    return make_parts(ENV, CONFIG)


@pytest.fixture(scope="session")
def algorithm():
    """Jitted; any second trace of `update` by any test is an error."""
    pure = make_hmasd(ENV, CONFIG)
    update = chex.assert_max_traces(pure.update, n=1)
    return pure._replace(init=jax.jit(pure.init), update=jax.jit(update))


@pytest.fixture(scope="session")
def trained(algorithm):
    """A state after five updates: networks are no longer at their special initial values."""
    state = algorithm.init(jax.random.key(0))
    for _ in range(5):
        state, _ = algorithm.update(state)
    return state


@pytest.fixture(scope="session")
def rollout(parts, trained):
    """Collect the next rollout of the trained state."""
    run = jax.jit(lambda *args: collect(parts, *args))
    return run(
        trained.coordinator.params,
        trained.discoverer.params,
        trained.env,
        trained.memory,
        jax.random.key(1),
    )
