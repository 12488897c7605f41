"""One update of HMASD with every part of the general preset, and what its steps are given."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from envs_jax.alice_and_bob import AliceAndBob
from hmasd_jax.exploration.frontier_config import FrontierConfig
from hmasd_jax.exploration.successes import ImitationConfig
from hmasd_jax.hmasd import algorithm
from hmasd_jax.hmasd.batches import skill_steps
from hmasd_jax.hmasd.coefficients import skill_weight
from hmasd_jax.hmasd.components import make_parts
from hmasd_jax.hmasd.config import SolvedSkillsConfig
from hmasd_jax.hmasd.distance import DistanceConfig
from hmasd_jax.hmasd.rewards import low_level_reward
from hmasd_jax.rl.rollout import cut

DISCOUNT = 0.9


class Agreement(AliceAndBob):
    """Alice_and_Bob whose episodes end with a reward where both agents choose the last action."""

    def step(self, key, state, action):
        state, timestep = super().step(key, state, action)
        agree = (action == self.num_actions - 1).all()
        return state, timestep._replace(
            reward=agree.astype(jnp.float32),
            terminated=agree,
            truncated=timestep.done & ~agree,
        )


def pay_in_waves(bonus_state, outcome, key):
    """Return a bonus that differs from step to step and from copy to copy."""
    waves = jnp.cos(jnp.arange(outcome.reward.size, dtype=jnp.float32))
    return bonus_state, waves.reshape(outcome.reward.shape), {}


@pytest.fixture(scope="module")
def every_part(config):
    """Parts of a task that is solved, whose bonus is `pay_in_waves`."""
    changed = replace(
        config,
        extrinsic_coef=2.0,
        team_intrinsic_coef=0.3,
        individual_intrinsic_coef=0.5,
        distance=DistanceConfig(individual_coef=0.7, team_coef=0.4, epochs=1),
        frontier=FrontierConfig(coef=1.0),
        imitation=ImitationConfig(coef=1.0, capacity=16, inserts=16, greedy_copies=1),
        solved=SolvedSkillsConfig(skill_gain=2.0, random_share=0.5, balance=1.0),
        ppo=replace(config.ppo, discount=DISCOUNT),
    )
    parts = make_parts(Agreement(max_steps=7), changed)
    solved = parts.bonus._replace(update=pay_in_waves, unsolved=lambda *_, **__: jnp.float32(0))
    return replace(parts, bonus=solved)


@pytest.fixture(scope="module")
def update(every_part):
    """Return the state before and after an update, and what its steps took or gave by name."""

    def spy(name, index=None):
        """Note the argument `index` of a step, or its result."""
        step = getattr(algorithm, name)

        def noting(*arguments):
            result = step(*arguments)
            noted[name] = result if index is None else arguments[index]
            return result

        monkeypatch.setattr(algorithm, name, noting)

    @jax.jit
    def run(state):
        noted.clear()
        after, _ = algorithm.train_iteration(every_part, state)
        return after, noted

    noted = {}
    before = jax.jit(lambda key: algorithm.init_state(every_part, key))(jax.random.key(0))
    with pytest.MonkeyPatch.context() as monkeypatch:
        spy("collect")
        spy("log_q_of_skills")
        spy("unknown_share")
        spy("low_batch", index=4)
        spy("train_discoverer", index=4)
        spy("train_discriminators", index=2)
        return before, *run(before)


def test_the_low_level_is_paid_eq_4_and_distance_by_their_weight_and_the_bonus(every_part, update):
    before, _, noted = update
    outcome = noted["collect"].transitions.outcome
    log_q_team, log_q_individual, _ = noted["log_q_of_skills"]
    weight = skill_weight(every_part, before.bonus, outcome.reward, noted["unknown_share"])
    assert weight > 1.01
    team, individual, _ = every_part.distance.reward(before.distance, skill_steps(noted["collect"]))
    _, bonus, _ = pay_in_waves((), outcome, None)
    parts_of_it = (
        low_level_reward(
            outcome.reward.reshape(-1), log_q_team, log_q_individual, every_part.config, weight
        ),
        weight * (individual + team[:, None]),
        bonus.reshape(-1, 1),
    )
    assert all(np.std(part) > 1e-3 for part in parts_of_it)
    assert_allclose(noted["low_batch"].reshape(-1, 2), sum(parts_of_it), rtol=1e-4, atol=1e-5)


def test_a_share_of_the_segments_is_drawn_at_random_and_q_d_weighs_skills_alike(update):
    _, _, noted = update
    extras = noted["collect"].transitions.extras
    at_random = np.asarray(extras.renewed & ~extras.sampled)[:, 1:]  # The first copy is greedy.
    assert 0 < at_random.sum() < np.asarray(extras.renewed)[:, 1:].sum()
    weight = np.asarray(noted["train_discriminators"].weight)
    assert weight.std() > 0.01
    assert_allclose(noted["train_discoverer"], noted["unknown_share"])


def test_the_successes_of_the_rollout_are_stored_with_their_individual_skills(update):
    _, after, noted = update
    transitions = noted["collect"].transitions
    outcome = transitions.outcome
    assert np.asarray(outcome.truncated).any()
    to_come = np.zeros(outcome.reward.shape)
    follows = np.zeros(outcome.reward.shape[1])
    for t in reversed(range(len(to_come))):
        follows = outcome.reward[t] + DISCOUNT * follows * ~np.asarray(outcome.done[t])
        to_come[t] = follows
    obs, skills, action, to_come = cut(
        (
            transitions.timestep.obs,
            transitions.extras.assignment.skills,
            transitions.action,
            jnp.asarray(to_come),
        ),
        5,
    )
    stored = after.successes
    count = int(stored.next_slot) or len(stored.weight)
    assert 0 < count == int((np.asarray(to_come).max(1) > 0).sum())
    places = [
        int(np.argmax((np.asarray(obs) == np.asarray(stored.steps.obs[slot])).all((1, 2, 3))))
        for slot in range(count)
    ]
    assert len(set(places)) == count
    for slot, place in enumerate(places):
        assert_array_equal(stored.steps.obs[slot], obs[place])
        assert_array_equal(stored.steps.skills[slot], skills[place][..., 1:])
        assert_array_equal(stored.steps.action[slot], action[place])
        assert_allclose(stored.weight[slot], to_come[place] / to_come.max(), rtol=1e-5)
