"""EITI and EDTI compute what the original code computes (see golden/README.md)."""

from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.baselines.eiti import counts, interaction, tables
from hmasd_jax.baselines.eiti.config import EDTIConfig, EITIConfig, LocalStateConfig
from hmasd_jax.rl.gae import gae
from hmasd_jax.rl.ppo import PPOConfig

GOLDEN = Path(__file__).parents[2] / "golden" / "eiti"
DISCOUNT, GAE_LAMBDA = 0.9, 0.8
LOCAL = LocalStateConfig(table_size=2**20)
CURIOSITY = 3.0


def load(name):
    """Return the recorded rollout without its first step, which the original does not count."""
    with np.load(GOLDEN / f"{name}.npz") as file:
        data = dict(file)
    place, value = data.pop("place").astype(np.float32), data.pop("value")
    steps = SimpleNamespace(**{name: x[1:] for name, x in data.items()})
    steps.value, steps.next_value = value[1:-1], value[2:]
    steps.transitions = SimpleNamespace(
        timestep=SimpleNamespace(obs=place[1:-1]), action=steps.action.astype(np.int32),
        outcome=SimpleNamespace(obs=place[2:], reward=steps.team_reward),
    )  # fmt: skip
    steps.first_visits = place[1]  # counted by both
    return steps


@jax.jit
def explore(obs, action, next_obs, first_visits):
    transitions = SimpleNamespace(
        timestep=SimpleNamespace(obs=obs), action=action, outcome=SimpleNamespace(obs=next_obs)
    )
    agent = np.arange(first_visits.shape[-2])
    visits = tables.make_key(counts.VISIT, agent, counts.local_state(first_visits, LOCAL))
    table = tables.add(tables.init(LOCAL.table_size), visits)
    return counts.count(table, counts.make_keys(transitions, LOCAL))


@pytest.mark.parametrize("name", ["eiti", "edti"])
def test_counts_rewards_and_returns(name):
    data = load(name)
    steps = data.transitions
    _, explored = explore(steps.timestep.obs, steps.action, steps.outcome.obs, data.first_visits)
    assert_allclose(CURIOSITY * explored.novelty, data.curiosity, rtol=1e-6)
    assert_allclose(explored.influence.sum(-1), data.influence, atol=1e-5)

    ppo = PPOConfig(discount=DISCOUNT)
    config = EDTIConfig(
        curiosity_coef=CURIOSITY, others_reward_coef=0.3, others_curiosity_coef=0.2,
        reward_value_coef=0.1, curiosity_value_coef=0.7, ppo=ppo,
    )  # fmt: skip
    streams = interaction.streams_of_reward(config, steps, explored)
    if name == "eiti":
        eiti = interaction.make_eiti_reward(EITIConfig(influence_coef=0.5))
        shared, _ = eiti.reward((), steps, None, explored)
    else:
        after = data.next_value[..., 1:]
        shared = interaction.edti_reward(config, streams, after, explored.influence)
    reward = streams.sum(-1) + shared
    assert_allclose(reward, data.reward, rtol=1e-5, atol=1e-5)

    rewards = np.concatenate([reward[..., None], streams], axis=-1)
    never = np.zeros(rewards.shape, bool)
    _, target = gae(rewards, data.value, data.next_value, never, never, DISCOUNT, GAE_LAMBDA)
    assert_allclose(target, data.target, rtol=1e-4, atol=1e-4)


def test_the_recorded_rollout_holds_what_is_hard():
    influence = load("eiti").influence
    assert (influence > 0.1).any()
    assert (influence < -0.1).any()
    visits = (CURIOSITY / load("eiti").curiosity) ** 2
    assert visits.max() > 5
