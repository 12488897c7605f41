import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hmasd_jax
from envs_jax.alice_and_bob import AliceAndBob
from hmasd_jax.config import TrainConfig, build, to_json
from hmasd_jax.hmasd import HMASDConfig
from hmasd_jax.hmasd.components import make_parts
from hmasd_jax.rl.evaluate import play
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.runs import checkpoint
from hmasd_jax.runs.checkpoint import CheckpointError
from hmasd_jax.runs.folder import RunError, checkpoint_folder, create, seed_folder
from hmasd_jax.runs.load import load_policy, load_run, make_policy
from tests.helpers.algorithms import draw_state

PPO = PPOConfig(hidden_size=8, num_envs=2, rollout_length=20, num_epochs=1)
CONFIG = TrainConfig(
    env=AliceAndBob(max_steps=20),
    algorithm=HMASDConfig(skill_interval=10, num_team_skills=3, discriminator_epochs=1, ppo=PPO),
)


@pytest.fixture(scope="module")
def states():
    _, algorithm = build(CONFIG)
    return {step: draw_state(algorithm, seed) for seed, step in enumerate((40, 80))}


@pytest.fixture(scope="module")
def run(states, tmp_path_factory):
    """A run of two seeds: one with checkpoints at 40 and 80, one that has just begun."""
    run = tmp_path_factory.mktemp("runs") / "run"
    create(run, CONFIG, ["test"])
    for step, state in states.items():
        folder = checkpoint_folder(run, 0)
        checkpoint.save(folder, step, state, to_json(CONFIG), 2)
    seed_folder(run, 1).mkdir()
    return run


def skills_in_use(policy, num_episodes: int = 3) -> np.ndarray:
    @jax.jit
    def extras(key):
        return play(CONFIG.env, policy, key, num_episodes).extras

    return np.asarray(extras(jax.random.key(0)))


def test_loads_the_newest_checkpoint(run, states):
    trained = load_run(run)
    assert trained.env_steps == 80
    assert trained.config == CONFIG
    expected = states[80]
    assert jax.tree.structure(trained.state) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, trained.state.coordinator, expected.coordinator)
    jax.tree.map(np.testing.assert_array_equal, trained.state.env, expected.env)
    assert trained.state.key == expected.key


def test_policy_acts_as_the_state_it_was_saved_from(run, states):
    env, algorithm = build(CONFIG)
    key = jax.random.key(3)

    def actions(policy):
        return np.asarray(jax.jit(lambda key: play(env, policy, key, 4).action)(key))

    loaded = actions(load_policy(run, step=40))
    np.testing.assert_array_equal(loaded, actions(algorithm.policy(states[40])))
    assert (loaded != actions(load_policy(run, step=80))).any()
    assert (loaded != actions(load_policy(run, step=40, greedy=False))).any()


def test_policy_acts_without_a_batch(run):
    policy = load_policy(str(run), greedy=False)
    _, timestep = CONFIG.env.reset(jax.random.key(0))
    memory, action, skills = jax.jit(policy.step)(
        policy.init(()), timestep, jnp.array(True), jax.random.key(1)
    )
    assert (action.shape, skills.shape) == ((2,), (3,))
    assert jax.tree.map(jnp.shape, memory) == jax.tree.map(jnp.shape, policy.init(()))


def test_holds_given_skills(run):
    assert (skills_in_use(load_policy(run, skills=(2, 3, 0))) == [2, 3, 0]).all()


def test_coordinator_completes_given_skills(run):
    """Individual skills are the most probable ones given the Z that is held, one after another."""
    trained = load_run(run)
    coordinator = make_parts(trained.env, trained.config.algorithm).coordinator
    policy = load_policy(run, skills=(2, None, None))

    @jax.jit
    def act_and_assess(key):
        _, timestep = jax.vmap(trained.env.reset)(jax.random.split(key, 16))
        _, _, skills = policy.step(policy.init((16,)), timestep, jnp.ones(16, bool), key)
        params = trained.state.coordinator.params
        logits, _ = coordinator.apply(params, timestep.state, timestep.obs, skills)
        return skills, logits

    skills, logits = act_and_assess(jax.random.key(0))
    assert (skills[:, 0] == 2).all()
    assert (logits[:, 0].argmax(-1) != 2).any()
    np.testing.assert_array_equal(skills[:, 1:], logits.argmax(-1)[:, 1:])


def test_holding_nothing_changes_nothing(run):
    np.testing.assert_array_equal(
        skills_in_use(load_policy(run)), skills_in_use(load_policy(run, skills=(None, None, None)))
    )


@pytest.mark.parametrize(
    ("skills", "message"),
    [
        ((0, 0), "skills must be Z and one per agent, 3 in all"),
        ((3, None, None), "team skill must be between 0 and 2, got 3"),
        ((0, 0, -1), "skill of agent 2 must be between 0 and 3, got -1"),
    ],
)
def test_skills_that_do_not_exist(run, skills, message):
    with pytest.raises(RunError, match=message):
        load_policy(run, skills=skills)


def test_algorithms_without_skills_hold_none(run):
    trained = load_run(run)
    without = trained._replace(config=SimpleNamespace(algorithm=PPO))
    with pytest.raises(RunError, match="PPO has no skills: choose a run of HMASD"):
        make_policy(without, (0, None, None))


def test_errors_name_what_is_there(run, tmp_path):
    with pytest.raises(RunError, match="is not a run folder"):
        load_policy(tmp_path)
    with pytest.raises(RunError, match="has no seed 5, but 0, 1"):
        load_policy(run, seed=5)
    with pytest.raises(CheckpointError, match=r"no checkpoint in .*seed_1"):
        load_policy(run, seed=1)
    with pytest.raises(CheckpointError, match=r"no checkpoint of step 60 in .*, but of 40, 80"):
        load_policy(run, step=60)


def test_is_exported_without_loading_anything():
    assert hmasd_jax.load_policy is load_policy
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        hmasd_jax.nothing  # noqa: B018
    code = "import sys, hmasd_jax; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
