"""A rollout of HMASD whose values are known, so that batches can be computed by hand."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from envs_jax import TimeStep
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.coordinator import Assignment
from hmasd_jax.hmasd.rollout_phase import Extras, Rollout, RolloutMemory
from hmasd_jax.networks.actor_critic import ActorCritic, ActorCriticMemory
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.rl.value_norm import ValueNorm
from hmasd_jax.types import EnvCarry, Transition

UNIT = ValueNorm(*jnp.array([0.0, 1.0, 1.0]))  # mean 0, deviation 1
PPO = PPOConfig(
    num_envs=1, rollout_length=4, sequence_length=2, discount=0.5, gae_lambda=0.5, hidden_size=1
)


def make_parts(bootstrap_truncation=False, num_envs=1, **fields):
    """Networks with known values: V_h = (20, 21) + s and V_l(s, Z) = s + 10 Z + 100 memory."""

    def encode(params, state, obs, method):
        assert method == "encode"
        return None, state + jnp.array([20.0, 21.0])

    def critic(params, memory, state, first, team_skill, method):
        memory = jnp.where(first[0][..., None], 0.0, memory)
        value = state[0] + 10 * team_skill[0][..., None] + 100 * memory
        return memory, value[None]

    ppo = PPOConfig(**vars(PPO) | {
        "bootstrap_truncation": bootstrap_truncation, "num_envs": num_envs
    })  # fmt: skip
    return SimpleNamespace(
        config=HMASDConfig(skill_interval=2, ppo=ppo, **fields),
        coordinator=SimpleNamespace(apply=encode),
        discoverer=ActorCritic(actor=None, critic=SimpleNamespace(apply=critic)),
    )


def make_rollout(
    reward=(1, 2, 4, 8),
    terminated=(0, 0, 0, 0),
    truncated=(0, 0, 0, 0),
    renewed=(1, 0, 1, 0),
    team_value=(1, 1, 3, 3),
    low_value=(1, 2, 3, 4),
):
    """Four steps of one copy with one agent.

    Step t starts from state 10 t and leads to state 10 t + 5. The rollout stops at state 40,
    where the coordinator's values are (5, 6) and Z' = 1; everywhere else Z = 0. The agent's V_h
    is the team's plus 1.
    """
    terminated, truncated = (np.array(x, bool)[:, None] for x in (terminated, truncated))
    done = terminated | truncated
    time = np.arange(4.0, dtype=np.float32)[:, None]

    def seen(state, **fields):
        blank = np.zeros(state.shape, np.float32)
        timestep = TimeStep(
            obs=state[..., None, None] + 0.5, state=state[..., None],
            action_mask=np.ones((*state.shape, 1, 2), bool), reward=blank,
            terminated=blank > 0, truncated=blank > 0, info={},
        )  # fmt: skip
        return timestep._replace(**fields)

    value = np.array(team_value, np.float32)[:, None, None] + np.array([0, 1], np.float32)
    skills = np.zeros((4, 1, 2), int)
    skills[2:, :, 1] = 1
    transitions = Transition(
        timestep=seen(10 * time),
        first=np.concatenate([np.ones((1, 1), bool), done[:-1]]),
        action=np.arange(4)[:, None, None] % 2,
        extras=Extras(
            low=ActorCriticMemory(time[..., None, None], time[..., None]),
            log_prob=-time[..., None],
            value=np.array(low_value, np.float32)[:, None],
            assignment=Assignment(skills, np.zeros((4, 1, 2), np.float32), value),
            renewed=np.array(renewed, bool)[:, None],
            sampled=np.array(renewed, bool)[:, None],
        ),
        outcome=seen(
            10 * time + 5,
            reward=np.array(reward, np.float32)[:, None],
            terminated=terminated,
            truncated=truncated,
        ),
    )
    following = Assignment(
        np.array([[1, 0]]), np.zeros((1, 2), np.float32), np.array([[5, 6]], np.float32)
    )
    memory = RolloutMemory(ActorCriticMemory(np.full((1, 1, 1), 4.0), np.full((1, 1), 4.0)),
                           following, np.array([4]))  # fmt: skip
    env = EnvCarry((), seen(np.full(1, 40, np.float32)), done[-1])
    return jax.tree.map(jnp.asarray, Rollout(transitions, env, memory, following))
