"""EITI and EDTI: exact replay, agents that learn alone, values of interaction, a solved probe."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from envs_jax.alice_and_bob import AliceAndBob
from hmasd_jax import config as configs
from hmasd_jax.baselines.eiti import algorithm, critics
from hmasd_jax.baselines.eiti.algorithm import make_edti, make_eiti
from hmasd_jax.baselines.eiti.config import EDTIConfig, EITIConfig, LocalStateConfig
from hmasd_jax.baselines.mappo import algorithm as mappo
from hmasd_jax.networks.actor_critic import SequenceBatch
from hmasd_jax.rl.evaluate import evaluate
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.rl.sgd import make_optimizer
from hmasd_jax.rl.value_norm import ValueNorm
from hmasd_jax.types import EnvCarry, Learner
from hmasd_jax.validation import ConfigError
from tests.helpers.algorithms import assert_no_key_is_used_twice

PRESETS = Path(__file__).parents[3] / "configs" / "overcooked" / "cramped_room"

ENV = AliceAndBob(max_steps=7)  # episodes end inside sequences of 5 steps
PPO = PPOConfig(
    num_envs=4, rollout_length=20, sequence_length=5, num_epochs=1, hidden_size=8,
    learning_rate=1e-2,
)  # fmt: skip
LOCAL = LocalStateConfig(features=(9, 10), table_size=4096)
MAKE = {
    "eiti": (make_eiti, EITIConfig(ppo=PPO, recurrent=False, local_state=LOCAL)),
    "edti": (make_edti, EDTIConfig(ppo=PPO, local_state=LOCAL)),
}


@pytest.fixture(scope="module", params=["eiti", "edti"])
def trained(request):
    """States of two seeds before and after three updates, at once."""
    make, config = MAKE[request.param]
    pure = make(ENV, config)

    @jax.jit
    def train(keys):
        start = jax.vmap(pure.init)(keys)
        state, metrics = jax.lax.scan(
            lambda state, _: jax.vmap(pure.update)(state), start, length=3
        )
        return start, state, jax.tree.map(lambda x: x[-1], metrics)

    keys = jax.random.split(jax.random.key(0))
    return SimpleNamespace(name=request.param, pure=pure, keys=keys, out=train(keys))


def test_update_replays_exactly_and_moves_all_weights(trained):
    start, state, metrics = trained.out
    chex.assert_tree_all_finite(metrics)
    assert (metrics["ratio_error"] < 1e-5).all()
    assert (metrics["episodes"] > 0).all()
    moved = jax.tree.map(
        lambda a, b: bool((a != b).any()), start.learner.params, state.learner.params
    )
    assert all(jax.tree.leaves(moved)), moved
    assert (state.num_updates == 3).all()
    # Every step of two agents counts 2 visits, 4 keys of one agent and 4 of pairs, in each row.
    assert (state.table.sum(-1) == 3 * 4 * 20 * (2 + 4 + 4)).all()
    if trained.name == "edti":
        moved = jax.tree.map(
            lambda a, b: bool((a != b).any()),
            start.interaction.learner.params,
            state.interaction.learner.params,
        )
        assert all(jax.tree.leaves(moved)), moved


def test_agents_share_no_weights(trained):
    kernel = trained.out[0].learner.params["actor"]["params"]["MLP_0"]["Dense_0"]["kernel"]
    assert kernel.shape[1] == ENV.num_agents
    assert abs(kernel[:, 0] - kernel[:, 1]).max() > 0.1


def test_no_key_is_used_twice():
    make, config = MAKE["edti"]
    assert_no_key_is_used_twice(make(ENV, config), PPO.num_envs)


def random_batch(rng):
    """Return 3 sequences of 5 steps of two agents."""

    def draw(*shape):
        return rng.normal(size=(3, 5, 2, *shape)).astype(np.float32)

    memory = np.zeros((3, 2, PPO.hidden_size), np.float32)
    return SequenceBatch(
        memory=mappo.ActorCriticMemory(memory, memory), first=np.ones((3, 5), bool),
        obs=draw(ENV.obs_dim), state=draw(ENV.obs_dim), action_mask=draw(5) < 9,
        action=rng.integers(5, size=(3, 5, 2)), log_prob=draw(), value=draw(), advantage=draw(),
        target=draw(),
    )  # fmt: skip


def random_like(shapes, rng):
    """Return arrays of the given shapes, drawn instead of initialized, which compiles nothing."""
    return jax.tree.map(lambda x: rng.normal(size=x.shape).astype(x.dtype), shapes)


def test_an_agent_learns_from_its_own_steps_alone():
    config = EITIConfig(ppo=replace(PPO, num_epochs=2), recurrent=False, local_state=LOCAL)
    one, each = algorithm.make_learners(ENV, config)
    parts = algorithm.Parts(ENV, config, one, each, None)
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(lambda: mappo.init_state(each, jax.random.key(0)).learner)
    params = random_like(shapes.params, rng)
    opt_state = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes.opt_state)
    zeros = jnp.zeros(2)
    state = SimpleNamespace(learner=Learner(params, opt_state), norm=ValueNorm(zeros, zeros, zeros))
    batch, other = random_batch(rng), random_batch(rng)
    mixed = {
        name: np.stack([getattr(batch, name)[:, :, 0], getattr(other, name)[:, :, 1]], axis=2)
        for name in ("obs", "state", "action", "log_prob", "value", "advantage", "target")
    }
    learn = jax.jit(lambda batch: algorithm._learn(parts, state, batch, jax.random.key(2))[:2])
    before, after = learn(batch), learn(batch._replace(**mixed))
    of_agent = [jax.tree.map(lambda x, i=i: x[i], (before, after)) for i in range(2)]
    chex.assert_trees_all_equal(*of_agent[0])
    changed = jax.tree.map(lambda a, b: (a != b).any(), *of_agent[1])
    assert all(jax.tree.leaves((changed[0].params, changed[1].mean))), changed


def test_batches_of_agents_keep_their_steps():
    batch = random_batch(np.random.default_rng(1))
    split = algorithm.split_agents(batch)
    assert split.obs.shape == (2, 3, 5, 1, ENV.obs_dim)
    assert split.memory.actor.shape == (2, 3, 1, PPO.hidden_size)
    assert split.first.shape == (2, 3, 5)
    np.testing.assert_array_equal(split.target[1, ..., 0], batch.target[..., 1])
    np.testing.assert_array_equal(split.obs[0, :, :, 0], batch.obs[:, :, 0])


@pytest.mark.parametrize("bootstrap", [False, True])
def test_values_of_interaction_are_those_of_the_next_step(bootstrap):
    """Time limits end an episode, or are bootstrapped from the true last observation."""
    ppo = replace(PPO, bootstrap_truncation=bootstrap)
    one, each = algorithm.make_learners(ENV, EDTIConfig(ppo=ppo, local_state=LOCAL))
    optimizer = make_optimizer(ppo, ["critic"])
    parts = critics.CriticParts(ppo, one.networks, each.networks, optimizer)
    rng, shape = np.random.default_rng(0), (6, 3)  # steps, copies
    obs = rng.normal(size=(2, 7, 3, 2, ENV.obs_dim)).astype(np.float32)
    truncated = np.zeros(shape, bool)
    truncated[[1, 4], [0, 2]] = True
    timestep = SimpleNamespace(obs=obs[0, :6])
    outcome = SimpleNamespace(
        obs=obs[1, :6], done=truncated, truncated=truncated, terminated=np.zeros(shape, bool)
    )
    first = np.concatenate([np.ones((1, 3), bool), truncated])
    steps = SimpleNamespace(timestep=timestep, outcome=outcome, first=first[:-1])
    env = EnvCarry(None, SimpleNamespace(obs=obs[0, 6]), first[-1])
    shapes = jax.eval_shape(lambda: critics.init(parts, env, jax.random.key(0)))
    mean, square, weight = np.array([[2.0, 0, 1, 3], [8.0, 1, 3, 10], [1.0, 1, 1, 1]], np.float32)
    params = random_like(shapes.learner.params, rng)
    state = critics.Critics(
        Learner(params, ()), ValueNorm(mean, square, weight), np.zeros((3, 4, 8), np.float32)
    )
    found = jax.jit(lambda state: critics.evaluate(parts, state, steps, env))(state)

    scale = np.sqrt(square - mean**2)
    after = np.asarray(found.after)
    followed = ~truncated[:-1]
    following = found.value[1:][followed] * scale + mean
    np.testing.assert_allclose(after[:-1][followed], following, rtol=1e-4, atol=1e-5)
    memory = np.asarray(found.memory)[1:][truncated[:-1]]
    last_obs = obs[1, :5][truncated[:-1]].repeat(2, axis=-2)
    _, value = parts.each.value(params, memory, last_obs, np.zeros(2, bool))
    expected = value * scale + mean if bootstrap else np.zeros((2, 4))
    np.testing.assert_allclose(after[truncated], expected, rtol=1e-4, atol=1e-5)


SMALL = PPOConfig(
    num_envs=32, rollout_length=10, sequence_length=5, hidden_size=16, num_epochs=5,
    learning_rate=5e-3, discount=0.5,
)  # fmt: skip


@pytest.mark.parametrize("name", ["eiti", "edti"])
def test_a_probe_is_solved(name):
    make, config = MAKE[name]
    env = envs_jax.make("probe_match_cue")
    local = LocalStateConfig(features=(0, 1, 4, 5), table_size=4096)
    pure = make(env, replace(config, ppo=SMALL, recurrent=False, local_state=local))

    @jax.jit
    def train(key):
        state, metrics = jax.lax.scan(
            lambda state, _: pure.update(state), pure.init(key), length=40
        )
        return metrics, evaluate(env, pure.policy(state), jax.random.key(1), 100)

    metrics, result = train(jax.random.key(0))
    assert result["return"] >= 0.97, result
    curiosity = metrics["exploration/curiosity_reward"]
    assert curiosity[-1] < 0.2 * curiosity[0]
    assert abs(metrics["exploration/influence"][-10:]).max() < 0.05  # cues are independent


def test_bad_input_is_one_clear_error():
    with pytest.raises(ConfigError, match="features has index 11, but obs has 11 features"):
        make_eiti(ENV, EITIConfig(local_state=LocalStateConfig(features=(2, 11))))
    alone = SimpleNamespace(num_agents=1, num_actions=2, obs_dim=3)
    with pytest.raises(ConfigError, match="env has 1 agent: choose ippo"):
        make_edti(alone, EDTIConfig())
    for fields in ({"curiosity_coef": -1.0}, {"influence_coef": -0.1}):
        with pytest.raises(ValueError, match=f"{next(iter(fields))} must be at least 0"):
            EITIConfig(**fields)
    with pytest.raises(ValueError, match="curiosity_value_coef must be at least 0"):
        EDTIConfig(curiosity_value_coef=-0.1)


@pytest.mark.parametrize("name", ["eiti", "edti"])
@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"sequence_length": 7}, "algorithm.ppo.rollout_length 400 is not a multiple of"),
        ({"num_minibatches": 7}, "algorithm.ppo.num_minibatches 7 does not divide"),
    ],
)
def test_parts_of_sequences_are_refused(name, setting, message):
    overrides = {f"algorithm.ppo.{key}": value for key, value in setting.items()}
    with pytest.raises(ConfigError, match=message):
        configs.load(PRESETS / f"{name}.toml", overrides)
