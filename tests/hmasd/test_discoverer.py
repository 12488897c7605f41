"""The discoverer: inputs of actor and critic, legal actions, and Eq. 7 by hand."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.hmasd.discoverer import discoverer_loss
from hmasd_jax.networks.actor_critic import ActorCritic, ActorCriticMemory, SequenceBatch
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.rl.value_norm import ValueNorm

UNIT = ValueNorm(*jnp.array([0.0, 1.0, 1.0]))  # mean 0, deviation 1


def _batch(**fields):
    """One sequence of one step of two agents with two actions."""
    batch = SequenceBatch(
        memory=ActorCriticMemory(jnp.zeros((1, 2, 4)), jnp.zeros((1, 4))),
        first=jnp.zeros((1, 1), bool),
        obs=jnp.zeros((1, 1, 2, 1)),
        state=jnp.zeros((1, 1, 1)),
        action_mask=jnp.ones((1, 1, 2, 2), bool),
        skills=jnp.array([[[1, 0, 2]]]),
        action=jnp.array([[[0, 1]]]),
        log_prob=jnp.log(jnp.array([[[0.4, 0.5]]])),
        value=jnp.array([[1.0]]),
        advantage=jnp.array([[[-1.0, 2.0]]]),
        target=jnp.array([[[3.0, 0.0]]]),
    )
    return batch._replace(**fields)


def _networks(probability, value, seen=None):
    """Networks that answer the given numbers and note what they were asked."""

    def answer(name, numbers):
        def apply(params, memory, x, first, skill, method):
            if seen is not None:
                seen[name] = (memory, x, first, skill)
            return memory, jnp.asarray(numbers)

        return SimpleNamespace(apply=apply)

    return ActorCritic(answer("actor", np.log(probability)), answer("critic", value))


def test_eq_7_by_hand():
    # Agent 0 took action 0: ratio 0.6 / 0.4 = 1.5, advantage -1: min(-1.5, -1.2) = -1.5.
    # Agent 1 took action 1: ratio 1, advantage 2: 2. Mean over agents: 0.25.
    # V = 2 was 1 when acting, clipped to 1.2; it is fitted to both agents' returns 3 and 0:
    #   max(1^2, 1.8^2) / 2 = 1.62 and max(2^2, 1.2^2) / 2 = 2, mean 1.81.
    # Entropies H(0.6) = 0.673012 and H(0.5) = 0.693147, mean 0.683079.
    #   L_l = -0.25 + 1 * 1.81 - 0.01 * 0.683079
    networks = _networks([[[[0.6, 0.4], [0.5, 0.5]]]], [[[2.0]]])
    config = HMASDConfig(low_entropy_coef=0.01)
    params = {"actor": {}, "critic": {}}
    loss, metrics = discoverer_loss(params, networks, UNIT, _batch(), config)
    assert_allclose(loss, -0.25 + 1.81 - 0.00683079, rtol=1e-5)
    assert_allclose(metrics["entropy"], 0.683079, rtol=1e-5)
    # Another lambda_l than the configured constant.
    loss, _ = discoverer_loss(params, networks, UNIT, _batch(), config, 0.5)
    assert_allclose(loss, -0.25 + 1.81 - 0.5 * 0.683079, rtol=1e-5)


def test_the_dead_count_for_the_value_only():
    # As above, but agent 0 is dead: its only action has probability 1 and ratio 1. Policy and
    # entropy are agent 1's alone, 2 and 0.693147; V is still fitted to both returns: 1.81.
    networks = _networks([[[[1.0, 1e-9], [0.5, 0.5]]]], [[[2.0]]])
    batch = _batch(
        action_mask=jnp.array([[[[True, False], [True, True]]]]),
        log_prob=jnp.log(jnp.array([[[1.0, 0.5]]])),
    )
    params = {"actor": {}, "critic": {}}
    config = HMASDConfig(low_entropy_coef=0.01)
    loss, metrics = discoverer_loss(params, networks, UNIT, batch, config)
    assert_allclose(loss, -2.0 + 1.81 - 0.00693147, rtol=1e-5)
    assert_allclose(metrics["entropy"], 0.693147, rtol=1e-5)


def test_targets_are_normalized_and_values_are_not():
    # Mean 3, deviation 2: returns 5 and 1 become 1 and -1. V = 0, as when acting: (1 + 1) / 4.
    networks = _networks([[[[0.5, 0.5], [0.5, 0.5]]]], [[[0.0]]])
    norm = ValueNorm(*jnp.array([3.0, 13.0, 1.0]))
    batch = _batch(value=jnp.zeros((1, 1)), target=jnp.array([[[5.0, 1.0]]]))
    params = {"actor": {}, "critic": {}}
    _, metrics = discoverer_loss(params, networks, norm, batch, HMASDConfig())
    assert_allclose(metrics["value_loss"], 0.5, rtol=1e-6)


def test_the_actor_sees_its_own_skill_and_the_critic_the_teams():
    seen = {}
    networks = _networks([[[[0.5, 0.5], [0.5, 0.5]]]], [[[0.0]]], seen)
    batch = _batch(first=jnp.ones((1, 1), bool))
    params = {"actor": {}, "critic": {}}
    discoverer_loss(params, networks, UNIT, batch, HMASDConfig(num_team_skills=2, num_skills=4))
    # skills are Z = 1, z = (0, 2); axes are (L, S, N) and (L, S).
    np.testing.assert_array_equal(seen["actor"][3], [[[0, 2]]])
    np.testing.assert_array_equal(seen["critic"][3], [[1]])
    # Both agents' memories restart with the episode of their copy.
    np.testing.assert_array_equal(seen["actor"][2], [[[True, True]]])
    np.testing.assert_array_equal(seen["critic"][2], [[True]])


def test_sequences_run_along_time_whatever_the_number_of_samples():
    seen = {}
    samples, length = 3, 5
    obs = np.arange(samples * length, dtype=np.float32).reshape(samples, length, 1, 1)
    batch = jax.tree.map(
        lambda x: np.broadcast_to(x, (samples, length, *x.shape[2:])),
        _batch()._replace(memory=None),
    )._replace(
        obs=np.broadcast_to(obs, (samples, length, 2, 1)),
        memory=ActorCriticMemory(np.zeros((samples, 2, 4)), np.zeros((samples, 4))),
    )
    probability = np.full((length, samples, 2, 2), 0.5)
    networks = _networks(probability, np.zeros((length, samples, 1)), seen)
    discoverer_loss({"actor": {}, "critic": {}}, networks, UNIT, batch, HMASDConfig())
    np.testing.assert_array_equal(seen["actor"][1][:, 1, 0, 0], [5, 6, 7, 8, 9])


def test_illegal_actions_are_never_drawn_and_cost_no_gradient(parts, trained):
    env = parts.env
    mask = np.ones((1, 500, env.num_agents, env.num_actions), bool)
    mask[..., 0, 1] = mask[..., 0, 3] = False
    obs = np.random.default_rng(0).normal(size=(1, 500, env.num_agents, env.obs_dim))

    def distribution(params):
        return parts.discoverer.act(
            params,
            jnp.zeros((500, env.num_agents, 8)),
            jnp.asarray(obs, jnp.float32),
            mask,
            jnp.zeros((1, 500), bool),
            jnp.zeros((1, 500, env.num_agents), int),
        )[1]

    params = trained.discoverer.params
    drawn = jax.jit(lambda k: distribution(params).sample(seed=k))(jax.random.key(0))
    assert set(np.unique(drawn[..., 0])) == {0, 2, 4}
    assert set(np.unique(drawn[..., 1])) == {0, 1, 2, 3, 4}
    gradient = jax.jit(
        jax.grad(lambda p: (distribution(p).log_prob(drawn) + distribution(p).entropy()).sum())
    )(params)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradient))


def test_a_single_step_gives_what_a_sequence_of_one_step_gives(parts, trained):
    env, discoverer, params = parts.env, parts.discoverer, trained.discoverer.params
    rng = np.random.default_rng(0)
    obs = rng.normal(size=(4, env.num_agents, env.obs_dim)).astype(np.float32)
    state = rng.normal(size=(4, env.state_dim)).astype(np.float32)
    mask = np.ones((4, env.num_agents, env.num_actions), bool)
    first = np.array([True, False, True, False])
    skills, team_skill = np.array([[0, 1]] * 4), np.array([0, 1, 1, 0])
    actor, critic = rng.normal(size=(4, env.num_agents, 8)), rng.normal(size=(4, 8))
    memory, step = discoverer.act(params, actor, obs, mask, first, skills)
    memories, steps = discoverer.act(params, actor, *(x[None] for x in (obs, mask, first, skills)))
    assert_allclose(step.logits, steps.logits[0], atol=1e-6)
    assert_allclose(memory, memories, atol=1e-6)
    _, value = discoverer.value(params, critic, state, first, team_skill)
    _, values = discoverer.value(params, critic, *(x[None] for x in (state, first, team_skill)))
    assert_allclose(value, values[0], atol=1e-6)


def test_the_value_is_one_per_copy_and_depends_on_state_and_team_skill(parts, trained):
    state = np.random.default_rng(0).normal(size=(1, 4, parts.env.state_dim)).astype(np.float32)
    state[:, 2:] = state[:, :2]
    team_skill = np.array([[0, 0, 1, 1]])
    _, value = parts.discoverer.value(
        trained.discoverer.params,
        jnp.zeros((4, 8)),
        state,
        jnp.zeros((1, 4), bool),
        team_skill,
    )
    assert value.shape == (1, 4)
    assert abs(value[0, 0] - value[0, 1]) > 1e-3
    # The skill joins at the last layer, so it moves the value of every state by the same amount.
    assert abs(value[0, 0] - value[0, 2]) > 1e-3
    assert_allclose(value[0, 0] - value[0, 2], value[0, 1] - value[0, 3], atol=1e-4)


def test_actor_and_critic_share_nothing(parts, rollout, trained):
    from hmasd_jax.hmasd.batches import low_batch

    steps = rollout.transitions.outcome.reward.shape
    reward = np.random.default_rng(0).normal(size=(*steps, 2)).astype(np.float32)

    def gradient(params, low_entropy_coef):
        config = HMASDConfig(
            num_skills=3, low_entropy_coef=low_entropy_coef, ppo=PPOConfig(value_coef=0.0)
        )
        batch = low_batch(parts, params, UNIT, rollout, reward)
        return jax.grad(discoverer_loss, has_aux=True)(
            params, parts.discoverer, UNIT, batch, config
        )[0]

    grads = jax.jit(lambda p: gradient(p, 0.01))(trained.discoverer.params)
    assert all((g == 0).all() for g in jax.tree.leaves(grads["critic"]))
    assert any((g != 0).any() for g in jax.tree.leaves(grads["actor"]))
