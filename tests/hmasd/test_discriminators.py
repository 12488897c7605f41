"""The discriminators: what they see, and Eq. 8 by hand."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.discriminators import (
    LARGEST_WEIGHT,
    Discriminators,
    SkillPair,
    balance,
    center,
    discriminator_loss,
    log_q,
    log_q_of_skills,
    make_discriminators,
    observe,
    weigh,
)
from hmasd_jax.rl.ppo import PPOConfig

# Two samples of two agents; skills are Z, z^1, z^2.
PAIR = SkillPair(
    state=jnp.array([[1.0, 2.0], [3.0, 4.0]]),
    obs=jnp.arange(12.0).reshape(2, 2, 3),
    skills=jnp.array([[0, 2, 0], [1, 1, 1]]),
)
Q_TEAM = np.array([[0.8, 0.2], [0.3, 0.7]])
Q_INDIVIDUAL = np.array([[[0.2, 0.3, 0.5], [0.25, 0.5, 0.25]], [[0.0, 1.0, 0.0], [0.6, 0.1, 0.3]]])


def _fixed(seen=None):
    """Discriminators that answer the tables above and note their inputs."""

    def answer(name, table):
        def apply(params, x, method):
            if seen is not None:
                seen[name] = x
            return jnp.log(jnp.asarray(table))

        return SimpleNamespace(apply=apply, num_classes=table.shape[-1])

    return Discriminators(answer("team", Q_TEAM), answer("individual", Q_INDIVIDUAL))


PARAMS = {"team": {}, "individual": {}}


def test_eq_8_by_hand():
    # q_D of the skills in use: 0.8, 0.7. q_d: 0.5, 0.25; 1.0, 0.1.
    #   -(ln 0.8 + ln 0.7) / 2 = 0.289909
    #   -(ln 0.5 + ln 0.25 + ln 1 + ln 0.1) / 4 = 1.095507, mean over samples and agents
    loss, metrics = discriminator_loss(PARAMS, _fixed(), PAIR)
    assert_allclose(metrics["team_loss"], 0.289909, rtol=1e-5)
    assert_allclose(metrics["individual_loss"], 1.095507, rtol=1e-5)
    assert_allclose(loss, 0.289909 + 1.095507, rtol=1e-5)


def test_values_are_those_of_the_skills_in_use():
    team, individual, metrics = log_q_of_skills(PARAMS, _fixed(), PAIR)
    assert_allclose(jnp.exp(team), [0.8, 0.7], rtol=1e-5)
    assert_allclose(jnp.exp(individual), [[0.5, 0.25], [1.0, 0.1]], rtol=1e-5)
    # Both team skills lead; of the agents' only the first of each sample.
    assert_allclose(metrics["team_accuracy"], 1.0)
    assert_allclose(metrics["individual_accuracy"], 0.5)
    assert_allclose(metrics["log_q_team"], np.log([0.8, 0.7]).mean(), rtol=1e-5)


def test_q_D_sees_the_state_and_q_d_an_observation_with_the_team_skill():  # noqa: N802
    seen = {}
    log_q(PARAMS, _fixed(seen), PAIR)
    np.testing.assert_array_equal(seen["team"], PAIR.state)
    np.testing.assert_array_equal(seen["individual"][..., :3], PAIR.obs)
    one_hot = [[[1, 0], [1, 0]], [[0, 1], [0, 1]]]
    np.testing.assert_array_equal(seen["individual"][..., 3:], one_hot)


def _init(**fields):
    config = HMASDConfig(**fields, ppo=PPOConfig(hidden_size=8))
    networks = make_discriminators(config)
    keys = jax.random.split(jax.random.key(0))
    inputs = {"team": jnp.zeros(2), "individual": jnp.zeros(3 + config.num_team_skills)}
    init = {n: jax.jit(getattr(networks, n).init)(k, inputs[n]) for n, k in zip(inputs, keys)}
    return networks, init


def test_they_begin_almost_uniform():
    networks, params = _init(num_team_skills=2, num_skills=3)
    team, individual = jax.jit(lambda p: log_q(p, networks, PAIR))(params)
    assert_allclose(team, -np.log(2), atol=0.1)
    assert_allclose(individual, -np.log(3), atol=0.1)
    assert_allclose(jnp.exp(individual).sum(-1), 1.0, rtol=1e-5)


def test_each_loss_moves_its_own_network_only():
    networks, params = _init(num_team_skills=2, num_skills=3)

    def gradient_of(name):
        return jax.jit(
            jax.grad(lambda p: discriminator_loss(p, networks, PAIR)[1][f"{name}_loss"])
        )(params)

    for name, other in (("team", "individual"), ("individual", "team")):
        grads = gradient_of(name)
        assert any((g != 0).any() for g in jax.tree.leaves(grads[name]))
        assert all((g == 0).all() for g in jax.tree.leaves(grads[other]))


def test_a_single_team_skill_costs_and_teaches_nothing():
    networks, params = _init(num_team_skills=1, num_skills=3)
    pair = PAIR._replace(skills=PAIR.skills.at[:, 0].set(0))
    team, _, _ = log_q_of_skills(params, networks, pair)
    np.testing.assert_array_equal(team, 0.0)


def test_noise_is_independent_and_of_a_scale_drawn_for_each_sample():
    pair = SkillPair(jnp.zeros((500, 40)), jnp.ones((500, 2, 40)), jnp.zeros((500, 3), int))
    noisy = observe(pair, HMASDConfig(discriminator_noise=2.0), jax.random.key(0))
    state, obs = np.asarray(noisy.state), np.asarray(noisy.obs) - 1.0
    for noise in (state, obs):
        assert abs(noise.mean()) < 0.05
        # Deviations uniform on [0, 2], each known to 11 %: mean 1, deviation 2 / sqrt(12).
        scale = noise.std(-1).ravel()
        assert abs(scale.mean() - 1.0) < 0.08
        assert abs(scale.std() - 0.58) < 0.06
        assert scale.max() < 2.8
    assert abs(np.corrcoef(obs[:, 0].std(-1), obs[:, 1].std(-1))[0, 1]) < 0.2
    assert abs(np.corrcoef(state.ravel(), obs[:, 0].ravel())[0, 1]) < 0.04
    assert noisy.skills is pair.skills


def test_without_options_the_discriminators_see_everything_as_it_is():
    seen = observe(PAIR, HMASDConfig(), jax.random.key(0))
    assert seen.state is PAIR.state
    assert seen.obs is PAIR.obs


def test_centered_features_by_hand():
    # Means 3, 7 and 0 over samples and agents; variances 4, 0 and 2, on average 2.
    x = jnp.array([[[1.0, 7.0, -2.0], [5.0, 7.0, 0.0]], [[1.0, 7.0, 2.0], [5.0, 7.0, 0.0]]])
    expected = (x - jnp.array([3.0, 7.0, 0.0])) / np.sqrt(2.0)
    assert_allclose(center(x), expected, rtol=1e-6)
    assert_allclose(center(100.0 * x), expected, rtol=1e-6)
    pair = PAIR._replace(obs=x)
    seen = observe(pair, HMASDConfig(discriminator_center=True), jax.random.key(0))
    assert_allclose(seen.obs, expected, rtol=1e-6)
    assert_allclose(seen.state, [[-1.0, -1.0], [1.0, 1.0]], rtol=1e-6)


def test_what_never_changes_is_centered_to_nothing():
    np.testing.assert_array_equal(center(jnp.full((4, 3), 7.0)), 0.0)


def test_q_d_sees_the_chosen_features_only():
    config = HMASDConfig(discriminator_obs=(2, 0))
    seen = observe(PAIR, config, jax.random.key(0))
    np.testing.assert_array_equal(seen.obs, PAIR.obs[..., [2, 0]])
    assert seen.state is PAIR.state


def test_balanced_pairs_of_skills_have_the_same_total_weight():
    """(0, 1) is in use three times, (1, 1) once, and the other pairs never."""
    config = HMASDConfig(num_team_skills=2, num_skills=2)
    skills = jnp.array([[0, 1], [0, 1], [0, 1], [1, 1]])
    weight = balance(skills, config)
    assert weight.shape == (4, 1)
    assert_allclose(weight[:, 0], [2 / 3, 2 / 3, 2 / 3, 2], rtol=1e-6)


def test_a_rare_pair_has_a_bounded_weight():
    """One of 1,000 samples would weigh as much as all others."""
    config = HMASDConfig(num_team_skills=1, num_skills=2)
    skills = jnp.zeros((1000, 2), int).at[0, 1].set(1)
    weight = balance(skills, config)
    assert_allclose(weight[0] / weight[1], LARGEST_WEIGHT / (1 / (2 * 0.999)), rtol=1e-5)


def test_a_classifier_learns_no_preference_from_balanced_skills():
    """q_d sees nothing here. Nine of ten samples have skill 0, and it stays at even chances."""
    config = HMASDConfig(num_team_skills=1, num_skills=2)
    skills = jnp.zeros((10, 2), int).at[0, 1].set(1)
    logit = jnp.array([0.0, 0.0])

    def gradient(weight):
        def loss(logit):
            log_q = jax.nn.log_softmax(logit)[skills[:, 1:]]
            return -weigh(log_q, weight).mean()

        return jax.grad(loss)(logit)

    assert_allclose(gradient(balance(skills, config)), [0.0, 0.0], atol=1e-6)
    assert_allclose(gradient(None), [-0.4, 0.4], atol=1e-6)


def test_weights_count_in_the_loss_of_q_d_alone():
    weight = jnp.array([[0.5, 1.5]])
    _, plain = discriminator_loss(PARAMS, _fixed(), PAIR)
    _, metrics = discriminator_loss(PARAMS, _fixed(), PAIR._replace(weight=weight))
    log_q = log_q_of_skills(PARAMS, _fixed(), PAIR)[1]
    assert_allclose(metrics["individual_loss"], -(log_q * weight).mean(), rtol=1e-6)
    assert metrics["individual_loss"] != plain["individual_loss"]
    assert metrics["team_loss"] == plain["team_loss"]
