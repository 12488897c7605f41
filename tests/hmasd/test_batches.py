"""Batches of constructed rollouts, computed by hand; every option has its effect."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from envs_jax import TimeStep
from hmasd_jax.exploration.successes import ImitationConfig
from hmasd_jax.hmasd.batches import find_segments, high_batch, low_batch, skill_pairs
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.coordinator import Assignment
from hmasd_jax.hmasd.rollout_phase import Extras, Rollout, RolloutMemory
from hmasd_jax.networks.actor_critic import ActorCritic, ActorCriticMemory
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.rl.value_norm import ValueNorm
from hmasd_jax.types import EnvCarry, Transition

UNIT = ValueNorm(*jnp.array([0.0, 1.0, 1.0]))  # mean 0, deviation 1
CONFIG = HMASDConfig(skill_interval=2)
PPO = PPOConfig(
    num_envs=1, rollout_length=4, sequence_length=2, discount=0.5, gae_lambda=0.5, hidden_size=1
)


def _parts(bootstrap_truncation=False, num_envs=1, **fields):
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


def _rollout(
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


def _high(parts, rollout):
    """Targets by the step at which the segment begins, {t: (team's, agent's)}."""
    batch = high_batch(parts, {}, UNIT, rollout, jax.random.key(0))
    return batch, {int(s) // 10: tuple(t) for s, t in zip(batch.state[:, 0], batch.target.tolist())}


def test_one_sample_per_segment_with_targets_by_gae():
    # r^h = 1 + 2 = 3 and 4 + 8 = 12; V_h = (1, 2), (3, 4), then (5, 6); gamma = lambda = 0.5.
    #   delta_1 = 12 + 0.5 (5, 6) - (3, 4) = (11.5, 11)
    #   delta_0 =  3 + 0.5 (3, 4) - (1, 2) = (3.5, 3)
    #   A_0 = delta_0 + 0.25 delta_1 = (6.375, 5.75)
    # Targets A + V: (7.375, 7.75) and (14.5, 15).
    batch, targets = _high(_parts(), _rollout())
    assert targets == {0: (7.375, 7.75), 2: (14.5, 15.0)}
    # Advantages are normalized over segments and tokens together.
    values = np.array([[1, 2], [3, 4]])[np.asarray(batch.state[:, 0], int) // 20]
    advantage = np.asarray(batch.target) - values
    expected = (advantage - advantage.mean()) / (advantage.std() + 1e-5)
    assert_allclose(batch.advantage, expected, rtol=1e-5)
    # State, observation and skills are those at which the skills were drawn.
    assert_allclose(batch.obs[:, 0, 0], batch.state[:, 0] + 0.5)
    np.testing.assert_array_equal(batch.assignment.skills[:, 1], batch.state[:, 0] == 20)


def test_values_are_denormalized_for_gae():
    # With mean 3 and deviation 2 the normalized values 1, 2, 3, .. stand for 5, 7, 9, ..
    #   delta_1 = 12 + 0.5 (13, 15) - (9, 11) = (9.5, 8.5);  target (18.5, 19.5)
    norm = ValueNorm(*jnp.array([3.0, 13.0, 1.0]))
    batch = high_batch(_parts(), {}, norm, _rollout(), jax.random.key(0))
    last = batch.target[batch.state[:, 0] == 20]
    assert_allclose(last, [[18.5, 19.5]], rtol=1e-5)


def test_an_episode_that_ends_with_the_segment_cuts_the_return():
    # delta_0 = 3 - (1, 2), and nothing flows back from the second segment: target (3, 3).
    for end in ({"terminated": (0, 1, 0, 0)}, {"truncated": (0, 1, 0, 0)}):
        _, targets = _high(_parts(), _rollout(**end))
        assert targets == {0: (3.0, 3.0), 2: (14.5, 15.0)}


def test_by_the_rollouts_clock_an_end_inside_a_segment_is_not_seen():
    _, targets = _high(_parts(), _rollout(terminated=(1, 0, 0, 0)))
    assert targets == {0: (7.375, 7.75), 2: (14.5, 15.0)}


def test_by_the_episodes_clock_the_end_of_an_episode_ends_the_segment():
    # The episode ends with step 0, so segments are (0), (1, 2), (3), the last cut by the rollout's
    # end. Rewards 1, 6, 8; V_h (1, 2), (1, 2), (3, 4), then (5, 6).
    #   A_2 = 8 + 0.5 (5, 6) - (3, 4)                      = (7.5, 7)    target (10.5, 11)
    #   A_1 = 6 + 0.5 (3, 4) - (1, 2) + 0.25 A_2           = (8.375, 7.75)      (9.375, 9.75)
    #   A_0 = 1 - (1, 2)                                                        (1, 1)
    parts = _parts(segment_clock="episode")
    rollout = _rollout(terminated=(1, 0, 0, 0), renewed=(1, 1, 0, 1))
    batch, targets = _high(parts, rollout)
    assert targets == {0: (1.0, 1.0), 1: (9.375, 9.75), 3: (10.5, 11.0)}
    # Twice T / k slots: all three segments, and one of them again.
    assert len(batch.target) == 4


def test_by_the_episodes_clock_a_segment_begun_earlier_has_no_sample_in_this_rollout():
    # Steps 0 and 1 belong to a segment of the previous rollout, which has bootstrapped there.
    parts = _parts(segment_clock="episode")
    _, targets = _high(parts, _rollout(renewed=(0, 0, 1, 0)))
    assert targets == {2: (14.5, 15.0)}


@pytest.mark.parametrize("clock", ["rollout", "episode"])
def test_a_time_limit_can_be_bootstrapped_at_the_high_level(clock):
    # The time limit cuts the episode with step 1, in state 15: V_h = (35, 36).
    #   delta_0 = 3 + 0.5 (35, 36) - (1, 2), nothing flows back: target (20.5, 21).
    parts = _parts(bootstrap_truncation=True, segment_clock=clock)
    _, targets = _high(parts, _rollout(truncated=(0, 1, 0, 0)))
    assert targets[0] == (20.5, 21.0)
    # A terminated episode is not bootstrapped even so.
    _, targets = _high(parts, _rollout(terminated=(0, 1, 0, 0)))
    assert targets[0] == (3.0, 3.0)


def test_the_guard_drops_the_policy_term_exactly_when_all_segment_rewards_are_equal():
    guarded, plain = _parts(zero_reward_guard=True), _parts()
    equal, unequal = _rollout(reward=(0, 2, 2, 0)), _rollout(reward=(0, 2, 2, 1))
    assert (_high(guarded, equal)[0].advantage == 0).all()
    assert (abs(_high(plain, equal)[0].advantage) > 0.1).all()
    np.testing.assert_array_equal(
        _high(guarded, unequal)[0].advantage, _high(plain, unequal)[0].advantage
    )
    # The values go on learning.
    np.testing.assert_array_equal(_high(guarded, equal)[0].target, _high(plain, equal)[0].target)


def test_segments_know_their_own_end():
    segments = find_segments(_parts(), {}, _rollout(terminated=(1, 0, 0, 1)))
    np.testing.assert_array_equal(segments.begins[:, 0], [True, False, True, False])
    np.testing.assert_array_equal(segments.done[:, 0], [False, False, True, True])


def _low(parts, rollout, reward=(1, 2, 4, 8)):
    reward = jnp.array(reward, jnp.float32)[:, None, None]
    return low_batch(parts, {"critic": {}}, UNIT, rollout, reward)


def test_low_level_targets_run_through_changes_of_skill_to_a_fresh_team_skill():
    # V_l = 1, 2, 3, 4, then V_l(s = 40, Z' = 1) with memory 4: 40 + 10 + 400 = 450.
    #   A_3 = 8 + 225 - 4            = 229        target 233
    #   A_2 = 4 + 2 - 3   + A_3 / 4  = 60.25             63.25
    #   A_1 = 2 + 1.5 - 2 + A_2 / 4  = 16.5625           18.5625
    #   A_0 = 1 + 1 - 1   + A_1 / 4  = 5.140625          6.140625
    batch = _low(_parts(), _rollout())
    assert_allclose(batch.target.reshape(-1), [6.140625, 18.5625, 63.25, 233])
    advantage = np.array([5.140625, 16.5625, 60.25, 229])
    expected = (advantage - advantage.mean()) / advantage.std()
    assert_allclose(batch.advantage.reshape(-1), expected, rtol=1e-5)


def test_low_level_advantages_are_normalized_over_who_has_a_choice():
    # The agent dies with step 1: its last two advantages (above) do not count.
    rollout = _rollout()
    timestep = rollout.transitions.timestep
    dead = jnp.arange(4)[:, None, None, None] >= 2
    mask = timestep.action_mask & (~dead | jnp.array([True, False]))
    transitions = rollout.transitions._replace(timestep=timestep._replace(action_mask=mask))
    advantage = np.array([5.140625, 16.5625, 60.25, 229])
    expected = (advantage - advantage[:2].mean()) / advantage[:2].std()
    batch = _low(_parts(), rollout._replace(transitions=transitions))
    assert_allclose(batch.advantage.reshape(-1), expected, rtol=1e-5)


def test_the_low_levels_floor_is_in_units_of_its_rewards():
    advantage = np.array([5.140625, 16.5625, 60.25, 229])  # as above; their deviation is 90
    batch = _low(_parts(low_advantage_floor=200.0), _rollout())
    assert_allclose(batch.advantage.reshape(-1), (advantage - advantage.mean()) / 200, rtol=1e-5)
    plain, low = _low(_parts(), _rollout()), _low(_parts(low_advantage_floor=20.0), _rollout())
    np.testing.assert_array_equal(low.advantage, plain.advantage)


def test_low_level_values_are_denormalized_for_gae():
    # Mean 3, deviation 2: V_3 = 4 stands for 11, the last 450 for 903; 8 + 451.5 = 459.5.
    norm = ValueNorm(*jnp.array([3.0, 13.0, 1.0]))
    batch = low_batch(_parts(), {"critic": {}}, norm, _rollout(), jnp.full((4, 1, 1), 8.0))
    assert_allclose(batch.target.reshape(-1)[3], 459.5, rtol=1e-5)


def test_time_limits_are_terminal_unless_bootstrapped_with_the_true_last_state():
    # The episode is cut with step 1, in state 15, where the critic's memory is 2.
    #   terminal:     A_1 = 2 - 2 = 0, target 2
    #   bootstrapped: V_l(15, Z = 0) = 15 + 200 = 215; target 2 + 107.5
    # Both: nothing flows back over the cut; step 0 gets 1 + 0.5 * 2 + 0.25 A_1.
    rollout = _rollout(truncated=(0, 1, 0, 0))
    assert_allclose(_low(_parts(), rollout).target.reshape(-1)[:2], [2.0, 2.0])
    batch = _low(_parts(bootstrap_truncation=True), rollout)
    assert_allclose(batch.target.reshape(-1)[:2], [2 + 0.25 * 107.5, 109.5])
    rollout = _rollout(terminated=(0, 1, 0, 0))
    batch = _low(_parts(bootstrap_truncation=True), rollout)
    assert_allclose(batch.target.reshape(-1)[:2], [2.0, 2.0])


def test_each_sequence_begins_with_the_memory_of_its_first_step():
    batch = _low(_parts(), _rollout(terminated=(0, 0, 1, 0)))
    np.testing.assert_array_equal(batch.state[..., 0], [[0, 10], [20, 30]])
    np.testing.assert_array_equal(batch.memory.actor.reshape(-1), [0, 2])
    np.testing.assert_array_equal(batch.memory.critic.reshape(-1), [0, 2])
    np.testing.assert_array_equal(batch.first, [[True, False], [False, True]])
    np.testing.assert_array_equal(batch.skills[..., 1], [[0, 0], [1, 1]])
    np.testing.assert_array_equal(batch.action[..., 0], [[0, 1], [0, 1]])
    np.testing.assert_array_equal(batch.log_prob[..., 0], [[0, -1], [-2, -3]])
    np.testing.assert_array_equal(batch.value, [[1, 2], [3, 4]])


@pytest.mark.parametrize(
    ("discriminate", "states"),
    [("next", [10, 20, 30, 40]), ("outcome", [5, 15, 25, 35])],
)
def test_discriminators_see_what_came_after_the_step(discriminate, states):
    # `next` is what the following step starts from, across resets and at the rollout's end.
    pairs = skill_pairs(_parts(discriminate=discriminate), _rollout(terminated=(0, 1, 0, 1)))
    np.testing.assert_array_equal(pairs.state[:, 0, 0], states)
    np.testing.assert_array_equal(pairs.obs[:, 0, 0, 0], np.array(states) + 0.5)
    np.testing.assert_array_equal(pairs.skills[:, 0, 1], [0, 0, 1, 1])


def test_copies_do_not_mix():
    def stack(*rollouts):
        copies = [r._replace(env=r.env._replace(env_state=())) for r in rollouts]
        t = jax.tree.map(lambda *x: jnp.concatenate(x, 1), *(c.transitions for c in copies))
        rest = [
            jax.tree.map(lambda *x: jnp.concatenate(x, 0), *(getattr(c, f) for c in copies))
            for f in ("env", "memory", "next_assignment")
        ]
        return Rollout(t, *rest)

    one, two = _rollout(terminated=(0, 1, 0, 0)), _rollout(reward=(0, 3, 0, 1), low_value=(5,) * 4)
    parts = _parts(num_envs=2)
    reward = jnp.array([[1.0, 0], [2, 3], [4, 0], [8, 1]])[..., None]
    for rollout, order in ((stack(one, two), [0, 1]), (stack(two, one), [1, 0])):
        batch = low_batch(parts, {"critic": {}}, UNIT, rollout, reward[:, np.array(order)])
        targets = np.asarray(batch.target).reshape(2, 2, 2)  # (T / L, E, L)
        alone = [_low(_parts(), one), _low(_parts(), two, (0, 3, 0, 1))]
        for copy, index in enumerate(order):
            assert_allclose(targets[:, copy], alone[index].target[..., 0])
        batch = high_batch(parts, {}, UNIT, rollout, jax.random.key(0))
        both = [_high(_parts(), r)[0].target for r in (one, two)]
        expected = np.sort(np.concatenate(both).ravel())
        assert_allclose(np.sort(np.asarray(batch.target).ravel()), expected)


def test_low_advantages_are_normalized_by_copies_that_sample_and_blame_the_others(
    parts, trained, rollout
):
    """Two of the four copies of a real rollout count as greedy, and all as rewarded."""
    transitions = rollout.transitions
    outcome = transitions.outcome._replace(reward=jnp.ones_like(transitions.outcome.reward))
    rollout = rollout._replace(transitions=transitions._replace(outcome=outcome))
    greedy = replace(
        parts, config=replace(parts.config, imitation=ImitationConfig(greedy_copies=2))
    )
    reward = jax.random.normal(jax.random.key(2), rollout.transitions.action.shape)

    def advantage(parts):
        low = low_batch(parts, trained.discoverer.params, trained.discoverer_norm, rollout, reward)
        return low.advantage.reshape(-1, 4, *low.advantage.shape[1:])  # sequences, copies, ...

    blamed, sampled = advantage(greedy), advantage(parts)
    others = (sampled - sampled[:, 2:].mean()) / sampled[:, 2:].std()
    assert_allclose(blamed[:, 2:], others[:, 2:], atol=1e-3)
    assert_allclose(blamed[:, :2], np.minimum(others[:, :2] + 1, 0), atol=1e-3)
    assert (blamed[:, :2] < 0).any()


def test_greedy_copies_have_no_part_in_the_high_level_batch(parts, trained, rollout):
    greedy = replace(
        parts, config=replace(parts.config, imitation=ImitationConfig(greedy_copies=2))
    )
    high = high_batch(
        greedy, trained.coordinator.params, trained.coordinator_norm, rollout, jax.random.key(0)
    )
    others = rollout.transitions.extras.assignment.value[:, 2:].reshape(-1, high.target.shape[-1])
    assert all((value == others).all(-1).any() for value in high.assignment.value)
