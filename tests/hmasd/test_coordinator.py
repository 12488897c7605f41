"""The coordinator: who sees what, sampling, masks, and Eq. 6 by hand."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.hmasd.ablations import make_coordinator
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.coordinator import (
    Assignment,
    HighBatch,
    assign,
    coordinator_loss,
)
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.rl.value_norm import ValueNorm
from tests.helpers.algorithms import draw_like

AGENTS, STATE, OBS, SIZE = 3, 4, 5, 8
TOKENS = 1 + AGENTS


def _make(num_team_skills=2, num_skills=3, num_blocks=2):
    """A network far from its initial values, so that its choices are not all alike."""
    network = make_coordinator(
        HMASDConfig(
            num_team_skills=num_team_skills,
            num_skills=num_skills,
            num_blocks=num_blocks,
            num_heads=2,
            ppo=PPOConfig(hidden_size=SIZE),
        )
    )
    shapes = jax.eval_shape(network.init, jax.random.key(0), *_inputs())
    return network, draw_like(shapes, seed=7)


def _inputs(batch=()):
    rng = np.random.default_rng(0)
    state = rng.normal(size=(*batch, STATE)).astype(np.float32)
    obs = rng.normal(size=(*batch, AGENTS, OBS)).astype(np.float32)
    return state, obs, np.zeros((*batch, TOKENS), int)


def _each_alone(network, params, *inputs):
    """Row by row: in a batch the place of a row may change the last bit of its result."""
    return jax.jit(lambda rows: jax.lax.map(lambda row: network.apply(params, *row), rows))(inputs)


@pytest.fixture(scope="module")
def made():
    return _make()


def test_logits_depend_on_earlier_skills_only(made):
    network, params = made
    state, obs, skills = _inputs()
    # Row 0 as it is; in row 1 + j skill j is changed.
    skills = np.stack([skills, *np.eye(TOKENS, dtype=int)])
    rows = len(skills)
    state, obs = (np.broadcast_to(x, (rows, *x.shape)) for x in (state, obs))
    logits, values = _each_alone(network, params, state, obs, skills)
    change = abs(logits[1:] - logits[0]).max(-1)  # [j, i]: effect of skill j on token i
    later = np.triu(np.ones((TOKENS, TOKENS), bool), 1)
    assert (change[~later] == 0).all()
    assert (change[later] > 1e-4).all()
    assert (values == values[0]).all()


def test_every_choice_and_value_depends_on_state_and_all_observations(made):
    network, params = made
    state, obs, skills = _inputs()
    states, all_obs = np.stack([state] * (2 + AGENTS)), np.stack([obs] * (2 + AGENTS))
    states[1, 0] += 1
    for agent in range(AGENTS):
        all_obs[2 + agent, agent, 0] += 1
    skills = np.broadcast_to(skills, (2 + AGENTS, TOKENS))
    logits, values = jax.jit(network.apply)(params, states, all_obs, skills)
    assert (abs(logits[1:] - logits[0]).max(-1) > 1e-5).all()
    assert (abs(values[1:] - values[0]) > 1e-5).all()


def test_teacher_forced_log_probs_are_those_of_sampling(made):
    network, params = made
    state, obs, _ = _inputs((64,))
    drawn = jax.jit(lambda k: assign(network, params, state, obs, k))(jax.random.key(0))
    assert len(np.unique(drawn.skills, axis=0)) > 10
    logits, values = jax.jit(network.apply)(params, state, obs, drawn.skills)
    log_prob = np.take_along_axis(
        np.asarray(jax.nn.log_softmax(logits)), np.asarray(drawn.skills)[..., None], -1
    )[..., 0]
    assert_allclose(drawn.log_prob, log_prob, atol=1e-5)
    assert_allclose(drawn.value, values, atol=1e-5)


def test_greedy_takes_the_likeliest_skill_given_those_before(made):
    network, params = made
    state, obs, _ = _inputs((64,))
    greedy = jax.jit(lambda k: assign(network, params, state, obs, k, greedy=True))
    chosen = greedy(jax.random.key(0))
    logits, _ = jax.jit(network.apply)(params, state, obs, chosen.skills)
    np.testing.assert_array_equal(chosen.skills, logits.argmax(-1))
    np.testing.assert_array_equal(chosen.skills, greedy(jax.random.key(1)).skills)


def _joint_distribution(network, params, state, obs, num_team_skills, num_skills):
    """Probability of every (Z, z^1, .., z^N), by the chain rule over teacher-forced logits."""
    sizes = (num_team_skills, *[num_skills] * AGENTS)
    cells = np.stack(np.meshgrid(*map(np.arange, sizes), indexing="ij"), -1).reshape(-1, TOKENS)
    states, all_obs = (np.broadcast_to(x, (len(cells), *x.shape)) for x in (state, obs))
    logits, _ = jax.jit(network.apply)(params, states, all_obs, cells)
    log_prob = np.take_along_axis(np.asarray(jax.nn.log_softmax(logits)), cells[..., None], -1)
    return cells, np.exp(log_prob.sum((-2, -1)))


def test_drawn_skills_follow_the_probabilities():
    network, params = _make(2, 2, num_blocks=1)
    state, obs, _ = _inputs()
    cells, probability = _joint_distribution(network, params, state, obs, 2, 2)
    assert_allclose(probability.sum(), 1.0, rtol=1e-4)
    draws = 20_000
    states, all_obs = (np.broadcast_to(x, (draws, *x.shape)) for x in (state, obs))
    skills = jax.jit(lambda k: assign(network, params, states, all_obs, k).skills)(
        jax.random.key(3)
    )
    weights = 2 ** np.arange(TOKENS)
    counts = np.bincount(np.asarray(skills) @ weights, minlength=16)[cells @ weights]
    assert probability.min() * draws > 5  # for chi-square to hold
    assert probability.max() > 2 * probability.min()  # not the uniform distribution
    chi_square = ((counts - draws * probability) ** 2 / (draws * probability)).sum()
    # 16 cells: 15 degrees of freedom, exceeded with probability 0.001 above 37.7.
    assert chi_square < 37.7


@pytest.mark.parametrize(("num_team_skills", "num_skills"), [(2, 4), (4, 2), (1, 2)])
def test_surplus_skills_are_impossible_and_gradients_finite(num_team_skills, num_skills):
    network, params = _make(num_team_skills, num_skills, num_blocks=1)
    state, obs, _ = _inputs((256,))
    config = HMASDConfig(num_team_skills=num_team_skills, num_skills=num_skills)
    norm = ValueNorm(*jnp.array([0.0, 1.0, 1.0]))

    def run(key):
        drawn = assign(network, params, state, obs, key)
        batch = HighBatch(state, obs, drawn, jnp.ones(drawn.value.shape), drawn.value + 1.0)
        logits, _ = network.apply(params, state, obs, drawn.skills)
        loss = jax.grad(coordinator_loss, has_aux=True)
        return drawn.skills, logits, *loss(params, network, norm, batch, config)

    skills, logits, grads, metrics = jax.jit(run)(jax.random.key(0))
    assert int(skills[:, 0].max()) == num_team_skills - 1
    assert int(skills[:, 1:].max()) == num_skills - 1
    probability = np.asarray(jax.nn.softmax(logits))
    assert logits.shape[-1] == max(num_team_skills, num_skills)
    assert (probability[:, 0, num_team_skills:] == 0).all()
    assert (probability[:, 1:, num_skills:] == 0).all()
    assert_allclose(probability[:, 0, :num_team_skills].sum(-1), 1, rtol=1e-5)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(grads))
    # Entropy is that of the legal skills.
    entropy = -(probability * np.log(np.maximum(probability, 1e-30))).sum(-1)
    assert_allclose(metrics["team_entropy"], entropy[:, 0].mean(), rtol=1e-4, atol=1e-6)
    assert_allclose(metrics["skill_entropy"], entropy[:, 1:].mean(), rtol=1e-4)


def test_team_and_individual_skills_have_their_own_embeddings_of_size_max_plus_one(made):
    network, params = made
    # One-hots of max(2, 3) skills and the start symbol; bias-free.
    for name in ("embed_team_skill", "embed_skill"):
        assert set(params["params"][name]) == {"kernel"}
        assert params["params"][name]["kernel"].shape == (4, SIZE)
    # Without the individual embedding Z still acts on the agents' logits, z^1 no longer does.
    muted = {**params["params"], "embed_skill": {"kernel": np.zeros((4, SIZE), np.float32)}}
    state, obs, skills = _inputs()
    skills = np.stack([skills, *np.eye(TOKENS, dtype=int)[:2]])
    state, obs = (np.broadcast_to(x, (3, *x.shape)) for x in (state, obs))
    logits, _ = _each_alone(network, {"params": muted}, state, obs, skills)
    assert (abs(logits[1, 1:] - logits[0, 1:]).max(-1) > 1e-4).all()
    assert (logits[2] == logits[0]).all()


def test_start_symbol_is_index_0_and_skills_are_shifted_by_one(made):
    network, params = made
    state, obs, skills = _inputs()
    gradient = jax.jit(jax.grad(lambda p: network.apply(p, state, obs, skills + 1)[0].sum()))(
        params
    )["params"]
    rows = {n: abs(gradient[n]["kernel"]).max(-1) > 0 for n in ("embed_team_skill", "embed_skill")}
    # All skills are 1: the team's embedding sees the start symbol (0) and Z = 1 (2).
    np.testing.assert_array_equal(rows["embed_team_skill"], [True, False, True, False])
    np.testing.assert_array_equal(rows["embed_skill"], [False, False, True, False])


def test_skills_are_almost_uniform_at_first():
    config = HMASDConfig(num_team_skills=2, num_skills=3, ppo=PPOConfig(hidden_size=SIZE))
    network = make_coordinator(config)
    params = jax.jit(network.init)(jax.random.key(0), *_inputs())
    logits, _ = jax.jit(network.apply)(params, *_inputs())
    probability = jax.nn.softmax(logits)
    assert_allclose(probability[0], [1 / 2, 1 / 2, 0], atol=0.02)
    assert_allclose(probability[1:], 1 / 3, atol=0.02)


def test_eq_6_by_hand():
    # One segment, one agent; Z = 0 and z = 1 of two skills each.
    #   ratios      0.5 / 0.5 = 1            0.75 / 0.5 = 1.5, clipped at 1.2
    #   advantages  1                        2
    #   policy      -(1 * 1 + 1.2 * 2) / 2 = -1.7, the mean over the two tokens
    # Values 1 and 2 as when acting; targets 5 and 9, normalized with mean 3, deviation 2: 1, 3.
    #   value       (0^2 / 2 + 1^2 / 2) / 2 = 0.25
    #   entropy     (H(1/2) + H(1/4)) / 2 = (0.693147 + 0.562335) / 2 = 0.627741
    #   L_h = -1.7 + 1 * 0.25 - 0.1 * 0.627741
    logits = jnp.log(jnp.array([[[0.5, 0.5], [0.25, 0.75]]]))
    values = jnp.array([[1.0, 2.0]])
    network = SimpleNamespace(apply=lambda params, *_, method: (logits, values))
    old = Assignment(jnp.array([[0, 1]]), jnp.log(jnp.array([[0.5, 0.5]])), values)
    batch = HighBatch(
        jnp.zeros((1, 1)), jnp.zeros((1, 1, 1)), old, jnp.array([[1.0, 2.0]]), jnp.array([[5, 9]])
    )
    norm = ValueNorm(*jnp.array([3.0, 13.0, 1.0]))
    loss, metrics = coordinator_loss({}, network, norm, batch, HMASDConfig(high_entropy_coef=0.1))
    assert_allclose(loss, -1.7 + 0.25 - 0.0627741, rtol=1e-5)
    assert_allclose(metrics["team_entropy"], 0.693147, rtol=1e-5)
    assert_allclose(metrics["skill_entropy"], 0.562335, rtol=1e-5)
