"""Skills are renewed on time, in training and in evaluation."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from envs_jax import TimeStep
from hmasd_jax.exploration.successes import ImitationConfig
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.policy import hold, make_policy
from hmasd_jax.hmasd.rollout_phase import collect, read_clock


def test_the_rollouts_clock_ignores_episodes_and_the_episodes_clock_restarts_with_them():
    clock, first = jnp.arange(3, 8), jnp.array([False, True, False, False, True])
    for mode, times, renewed in [
        ("rollout", [3, 4, 5, 6, 7], [0, 0, 1, 0, 0]),
        ("episode", [3, 0, 5, 6, 0], [0, 1, 1, 0, 1]),
    ]:
        config = HMASDConfig(skill_interval=5, segment_clock=mode)
        time, due = read_clock(config, clock, first)
        np.testing.assert_array_equal(time, times)
        np.testing.assert_array_equal(due, renewed)


def test_in_training_all_copies_renew_every_k_steps_across_episode_ends(rollout, config):
    extras, first = rollout.transitions.extras, rollout.transitions.first
    steps = np.arange(20)
    np.testing.assert_array_equal(
        extras.renewed, np.broadcast_to((steps % 5 == 0)[:, None], (20, 4))
    )
    skills = np.asarray(extras.assignment.skills).reshape(4, 5, 4, 3)
    np.testing.assert_array_equal(skills, np.broadcast_to(skills[:, :1], skills.shape))
    assert len(np.unique(skills[:, 0].reshape(-1, 3), axis=0)) > 1
    # The rollout does cross episode ends, and not where skills are renewed.
    assert first.any(1).sum() >= 2
    assert (first & ~extras.renewed).any()


def test_values_and_log_probs_kept_are_those_of_the_draw(rollout, parts, trained):
    timestep, kept = rollout.transitions.timestep, rollout.transitions.extras.assignment
    begin = np.arange(0, 20, 5)
    logits, value = jax.jit(parts.coordinator.apply)(
        trained.coordinator.params, timestep.state[begin], timestep.obs[begin], kept.skills[begin]
    )
    log_prob = np.take_along_axis(
        np.asarray(jax.nn.log_softmax(logits)), np.asarray(kept.skills[begin])[..., None], -1
    )[..., 0]
    for at in begin:  # the same at all five steps of the segment
        for step in range(at, at + 5):
            assert_allclose(kept.log_prob[step], log_prob[at // 5], atol=1e-5)
            assert_allclose(kept.value[step], value[at // 5], atol=1e-5)


def test_greedy_copies_take_the_most_likely_skills_and_actions(rollout, parts, trained):
    config = replace(parts.config, imitation=ImitationConfig(greedy_copies=2))
    mixed = jax.jit(lambda *args: collect(replace(parts, config=config), *args))(
        trained.coordinator.params,
        trained.discoverer.params,
        trained.env,
        trained.memory,
        jax.random.key(1),
    )
    steps, sampled = mixed.transitions, rollout.transitions
    skills, timestep = steps.extras.assignment.skills, steps.timestep
    logits, _ = parts.coordinator.apply(
        trained.coordinator.params, timestep.state, timestep.obs, skills
    )
    begin = np.asarray(steps.extras.renewed)[:, :2]
    np.testing.assert_array_equal(logits.argmax(-1)[:, :2][begin], skills[:, :2][begin])
    _, distribution = jax.vmap(parts.discoverer.act, in_axes=(None, 0, 0, 0, 0, 0))(
        trained.discoverer.params,
        steps.extras.low.actor,
        timestep.obs,
        timestep.action_mask,
        steps.first,
        skills[..., 1:],
    )
    np.testing.assert_array_equal(distribution.mode()[:, :2], steps.action[:, :2])
    assert_allclose(distribution.log_prob(steps.action), steps.extras.log_prob, atol=1e-5)
    # The other copies play as they would without.
    np.testing.assert_array_equal(steps.action[:, 2:], sampled.action[:, 2:])
    assert (steps.action[:, :2] != sampled.action[:, :2]).any()
    # The coordinator learns from them alone.
    assert not steps.extras.sampled[:, :2].any()
    np.testing.assert_array_equal(steps.extras.sampled[:, 2:], steps.extras.renewed[:, 2:])


def _timestep(env, key, batch):
    obs_key, state_key = jax.random.split(key)
    blank = jnp.zeros(batch)
    return TimeStep(
        obs=jax.random.normal(obs_key, (*batch, env.num_agents, env.obs_dim)),
        state=jax.random.normal(state_key, (*batch, env.state_dim)),
        action_mask=jnp.ones((*batch, env.num_agents, env.num_actions), bool),
        reward=blank,
        terminated=blank > 0,
        truncated=blank > 0,
        info={},
    )


def _run_policy(parts, trained, greedy, first, key=0, skills=None, order=None, allowed=None):
    """Skills and actions of the policy over random timesteps, (T, copies, ..)."""
    steps, copies = first.shape
    order = np.arange(copies) if order is None else order

    def run(key):
        policy = make_policy(
            parts, trained.coordinator.params, trained.discoverer.params, greedy, skills, allowed
        )
        timesteps = _timestep(parts.env, jax.random.key(5), (steps, copies))

        def step(memory, inputs):
            timestep, first, key = inputs
            memory, action, extras = policy.step(memory, timestep, first, key)
            return memory, (extras, action)

        inputs = jax.tree.map(lambda x: x[:, order], (timesteps, jnp.asarray(first)))
        return jax.lax.scan(step, policy.init((copies,)), (*inputs, jax.random.split(key, steps)))

    return jax.tree.map(np.asarray, jax.jit(run)(jax.random.key(key))[1])


STEPS, COPIES = 16, 6
FIRST = np.zeros((STEPS, COPIES), bool)
FIRST[0] = True
FIRST[3, 1] = FIRST[7, 1] = FIRST[9, 2] = True


@pytest.fixture(scope="module")
def sampled(parts, trained):
    return _run_policy(parts, trained, False, FIRST)


def test_in_evaluation_each_copy_renews_at_steps_0_k_2k_of_its_own_episodes(sampled):
    skills, _ = sampled
    changed = (skills[1:] != skills[:-1]).any(-1)
    time = np.zeros((STEPS, COPIES), int)
    for t in range(1, STEPS):
        time[t] = np.where(FIRST[t], 0, time[t - 1] + 1)
    due = (time % 5 == 0)[1:]
    assert not changed[~due].any()
    assert changed[due].mean() > 0.3  # a fresh draw is often a different one


def test_greedy_acting_needs_no_randomness_and_treats_copies_alike(parts, trained):
    skills, action = _run_policy(parts, trained, True, FIRST)
    again_skills, again_action = _run_policy(parts, trained, True, FIRST, key=9)
    np.testing.assert_array_equal(skills, again_skills)
    np.testing.assert_array_equal(action, again_action)
    # Permuting environment copies permutes what the policy does, nothing else.
    order = np.array([3, 1, 5, 0, 2, 4])
    permuted_skills, permuted_action = _run_policy(parts, trained, True, FIRST, order=order)
    np.testing.assert_array_equal(permuted_skills, skills[:, order])
    np.testing.assert_array_equal(permuted_action, action[:, order])


def test_the_mask_of_held_skills_allows_all_others(parts):
    skills, counts = (None, 1, None), (parts.config.num_team_skills, parts.config.num_skills)
    num_agents = parts.env.num_agents
    expected = np.ones((3, max(counts)), bool)
    np.testing.assert_array_equal(hold((None,) * 3, *counts, num_agents), expected)
    expected[1] = np.arange(max(counts)) == 1
    np.testing.assert_array_equal(hold(skills, *counts, num_agents), expected)
    assert hold((), 0, 0, num_agents).shape == (0, 0)  # Policies without skills.


def test_given_skills_are_followed_and_the_others_still_chosen(parts, trained):
    skills, _ = _run_policy(parts, trained, False, FIRST, skills=(1, None, 0))
    assert (skills[..., 0] == 1).all()
    assert (skills[..., 2] == 0).all()
    assert len(np.unique(skills[..., 1])) > 1


def test_a_removed_skill_is_never_given_and_the_others_are(parts, trained):
    config = parts.config
    allowed = np.ones((3, parts.coordinator.max_skills), bool)
    allowed[1, 2] = False
    skills, _ = _run_policy(parts, trained, False, FIRST, allowed=jnp.asarray(allowed))
    assert set(np.unique(skills[..., 1])) == set(range(config.num_skills)) - {2}
    assert set(np.unique(skills[..., 2])) == set(range(config.num_skills))
    assert skills[..., 0].max() < config.num_team_skills


def test_to_allow_one_skill_is_to_hold_it(parts, trained):
    held = _run_policy(parts, trained, True, FIRST, skills=(1, None, 0))
    allowed = np.ones((3, parts.coordinator.max_skills), bool)
    allowed[0], allowed[2] = False, False
    allowed[0, 1] = allowed[2, 0] = True
    np.testing.assert_array_equal(
        held[0], _run_policy(parts, trained, True, FIRST, allowed=jnp.asarray(allowed))[0]
    )


@pytest.mark.parametrize(
    ("skills", "message"),
    [((0, 1), "3 in all"), ((2, 0, 0), "team skill"), ((0, 0, 3), "skill of agent")],
)
def test_skills_that_do_not_exist_are_refused(parts, trained, skills, message):
    with pytest.raises(ValueError, match=message):
        make_policy(parts, trained.coordinator.params, trained.discoverer.params, True, skills)


def _primitives(jaxpr):
    """Names of all primitives, inside scans too."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else (value,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from _primitives(inner)


@pytest.mark.parametrize(("clock", "skips"), [("rollout", True), ("episode", False)])
def test_over_seeds_the_coordinator_still_runs_only_every_k_steps(parts, trained, clock, skips):
    # vmap turns a branch whose condition differs between seeds into computing both sides.
    parts = replace(parts, config=replace(parts.config, segment_clock=clock))

    def run(state, key):
        networks = state.coordinator.params, state.discoverer.params
        return collect(parts, *networks, state.env, state.memory, key).next_assignment.skills

    pair = jax.tree.map(lambda x: jnp.stack([x, x]), trained)
    jaxpr = jax.make_jaxpr(jax.vmap(run))(pair, jax.random.split(jax.random.key(0)))
    assert ("cond" in set(_primitives(jaxpr.jaxpr))) == skips
