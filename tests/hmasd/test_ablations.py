"""The paper's ablations: what is assigned without a part, and that the rest goes on."""

import re
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hmasd_jax.hmasd.algorithm import make_hmasd
from hmasd_jax.hmasd.batches import high_batch
from hmasd_jax.hmasd.components import make_parts
from hmasd_jax.hmasd.coordinator import assign, coordinator_loss
from hmasd_jax.hmasd.policy import hold
from hmasd_jax.hmasd.rollout_phase import collect


@pytest.fixture(scope="module")
def team_only(config):
    return replace(config, coordinator="team_only", num_skills=2)


@pytest.fixture(scope="module")
def random(config):
    return replace(config, coordinator="random", segment_clock="episode", skill_interval=7)


def _assign(parts, greedy=False, skills=None, copies=4000):
    """Skills for the same state, many times over, and what else is known of them."""
    env = parts.env
    state, obs = jnp.zeros((1, env.state_dim)), jnp.zeros((1, env.num_agents, env.obs_dim))
    tokens = jnp.zeros((1, 1 + env.num_agents), int)
    params = jax.jit(parts.coordinator.init)(jax.random.key(0), state, obs, tokens)
    state, obs = (jnp.repeat(x, copies, axis=0) for x in (state, obs))
    config, num_agents = parts.config, parts.env.num_agents
    counts = (config.num_team_skills, config.num_skills, num_agents)
    allowed = None if skills is None else jnp.asarray(hold(skills, *counts))
    return jax.device_get(
        assign(parts.coordinator, params, state, obs, jax.random.key(1), greedy, allowed)
    )


@cache
def _initial(env, config):
    return jax.jit(make_hmasd(env, config).init)(jax.random.key(0))


def _rollout(parts):
    state = _initial(parts.env, parts.config)
    learners = state.coordinator.params, state.discoverer.params
    run = jax.jit(lambda *args: collect(parts, *args))
    return state, run(*learners, state.env, state.memory, jax.random.key(1))


@pytest.mark.parametrize(
    ("greedy", "given"), [(False, None), (True, None), (False, (1, None, None))]
)
def test_without_individual_skills_all_agents_have_the_teams(parts, team_only, greedy, given):
    skills, log_prob, _ = _assign(make_parts(parts.env, team_only), greedy, given)
    assert (skills[:, 1:] == skills[:, :1]).all()
    assert (log_prob[:, 1:] == 0).all()
    assert (log_prob[:, 0] < 0).all()
    # A fresh coordinator has no preference: about half of the teams have each skill.
    assert len(set(skills[:, 0])) == (1 if greedy or given else 2)
    assert given is None or (skills[:, 0] == 1).all()


def test_without_individual_skills_only_the_teams_is_trained(parts, team_only):
    """The agents' advantages have no effect on the gradient of Eq. 6."""
    parts = make_parts(parts.env, team_only)
    state, rollout = _rollout(parts)
    params, norm = state.coordinator.params, state.coordinator_norm
    make_batch = jax.jit(lambda *args: high_batch(parts, *args))
    batch = make_batch(params, norm, rollout, jax.random.key(0))
    noise = jax.random.normal(jax.random.key(2), batch.advantage.shape)

    @jax.jit
    def gradient(advantage):
        changed = batch._replace(advantage=advantage)
        loss = lambda p: coordinator_loss(p, parts.coordinator, norm, changed, team_only)[0]  # noqa: E731
        return jax.flatten_util.ravel_pytree(jax.grad(loss)(params))[0]

    plain = gradient(noise)
    np.testing.assert_array_equal(plain, gradient(noise.at[:, 1:].multiply(-3.0)))
    assert abs(plain - gradient(noise.at[:, 0].multiply(-3.0))).max() > 1e-4


@pytest.mark.parametrize("greedy", [False, True])
def test_without_a_coordinator_skills_are_uniform(parts, random, greedy):
    """Evaluation asks for the most likely skills, but they are uniform there, too."""
    skills, log_prob, _ = _assign(make_parts(parts.env, random), greedy)
    for token, count in enumerate((2, 3, 3)):
        shares = np.bincount(skills[:, token], minlength=count) / len(skills)
        np.testing.assert_allclose(shares, 1 / count, atol=0.03)  # 4 standard errors
        np.testing.assert_allclose(log_prob[:, token], -np.log(count), rtol=1e-6)


def test_without_a_coordinator_skills_last_for_the_episode(parts, random):
    parts = make_parts(parts.env, random)
    _, rollout = _rollout(parts)
    first = np.asarray(rollout.transitions.first)
    assert first[1:].any()
    np.testing.assert_array_equal(rollout.transitions.extras.renewed, first)


@pytest.mark.parametrize("name", ["team_only", "random"])
def test_the_rest_is_trained(parts, request, name):
    config = request.getfixturevalue(name)
    before = _initial(parts.env, config)
    after, metrics = jax.jit(make_hmasd(parts.env, config).update)(before)
    assert all(
        np.isfinite(value).all() for value in jax.tree.leaves((after._replace(key=0), metrics))
    )
    for learner in ("coordinator", "discoverer", "discriminators"):
        old, new = (jax.tree.leaves(getattr(s, learner).params) for s in (before, after))
        assert any((a != b).any() for a, b in zip(old, new)), learner
    if name == "random":
        np.testing.assert_allclose(metrics["coordinator/team_entropy"], np.log(2), rtol=1e-6)
        np.testing.assert_allclose(metrics["coordinator/skill_entropy"], np.log(3), rtol=1e-6)
    else:
        assert metrics["coordinator/skill_entropy"] == 0


def test_the_teams_skill_must_be_one_an_agent_can_have(config):
    message = "num_skills 3 must be num_team_skills = 2 with coordinator team_only"
    with pytest.raises(ValueError, match=re.escape(message)):
        replace(config, coordinator="team_only")


def test_skills_that_last_for_the_episode_may_outlast_the_rollout(random):
    """And the coordinator's batch still has room for a segment of every copy."""
    longer = replace(random, skill_interval=300)
    assert longer.num_segments == 2 * longer.ppo.num_envs
    with pytest.raises(ValueError, match="is not a multiple of skill_interval 300"):
        replace(longer, segment_clock="rollout")


def test_a_coordinator_that_learns_needs_a_choice_of_skills_in_every_rollout(random):
    length = random.ppo.rollout_length
    replace(random, coordinator="learned", skill_interval=length)
    message = f"skill_interval must be at most ppo.rollout_length = {length}"
    with pytest.raises(ValueError, match=re.escape(message)):
        replace(random, coordinator="learned", skill_interval=length + 1)
