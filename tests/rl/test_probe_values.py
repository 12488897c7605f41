"""HMASD's low-level critic learns the values that are known for the probes without choices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from hmasd_jax.hmasd import HMASDConfig, make_hmasd
from hmasd_jax.hmasd.discoverer import make_discoverer
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.rl.value_norm import denormalize

NUM_EPISODES = 8


def learned_values(env, bootstrap_truncation=False):
    """V_l(s, Z=0) in reward units along episodes, (max_steps, episodes), and the common cues."""
    config = HMASDConfig(
        coordinator="random",
        num_team_skills=1,
        num_skills=1,
        skill_interval=env.max_steps,
        extrinsic_coef=1.0,
        team_intrinsic_coef=0.0,
        individual_intrinsic_coef=0.0,
        discriminator_epochs=1,
        ppo=PPOConfig(
            num_envs=32,
            rollout_length=4,
            hidden_size=16,
            num_epochs=5,
            learning_rate=5e-3,
            sequence_length=env.max_steps,
            discount=0.5,
            bootstrap_truncation=bootstrap_truncation,
        ),
    )
    hmasd = make_hmasd(env, config)
    discoverer = make_discoverer(env, config)

    @jax.jit
    def train(key):
        return jax.lax.scan(lambda s, _: hmasd.update(s), hmasd.init(key), length=40)[0]

    @jax.jit
    def evaluate(state):
        def step(carry, first):
            env_state, timestep, memory = carry
            memory, value = discoverer.value(
                state.discoverer.params, memory, timestep.state,
                jnp.full(NUM_EPISODES, first), jnp.zeros(NUM_EPISODES, int),
            )  # fmt: skip
            action = jnp.zeros((NUM_EPISODES, 2), int)
            env_state, timestep = jax.vmap(env.step)(keys, env_state, action)
            return (env_state, timestep, memory), denormalize(state.discoverer_norm, value)

        keys = jax.random.split(jax.random.key(1), NUM_EPISODES)
        env_state, timestep = jax.vmap(env.reset)(keys)
        carry = (env_state, timestep, jnp.zeros((NUM_EPISODES, 16)))
        return jax.lax.scan(step, carry, jnp.arange(env.max_steps) == 0)[1], env_state.cue[:, 0]

    return jax.tree.map(np.asarray, evaluate(train(jax.random.key(0))))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("probe_time_limit", [2.0, 2.0]),  # 1 + 0.5 V = V
        ("probe_delayed_reward", [0.5, 1.0]),  # a true end is not bootstrapped from
    ],
)
def test_value_when_time_limits_are_bootstrapped_from(name, expected):
    value, _ = learned_values(envs_jax.make(name), bootstrap_truncation=True)
    np.testing.assert_allclose(value, np.array(expected)[:, None].repeat(NUM_EPISODES, 1), atol=0.1)


def test_value_follows_what_is_observed():
    value, cue = learned_values(envs_jax.make("probe_observed_reward"))
    assert set(cue.tolist()) == {0, 1}
    np.testing.assert_allclose(value[0], 2 * cue - 1, atol=0.1)
