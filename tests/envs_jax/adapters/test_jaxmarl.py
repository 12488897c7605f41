"""Conversion of environments from JaxMARL, to JaxMARL, and there and back."""

import importlib.util
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from envs_jax import check_environment, from_jaxmarl, to_jaxmarl
from envs_jax.alice_and_bob import AliceAndBob
from envs_jax.probes import PROBES

pytestmark = [
    pytest.mark.skipif(
        importlib.util.find_spec("jaxmarl") is None, reason="jaxmarl is not installed"
    ),
    pytest.mark.filterwarnings(
        "ignore::DeprecationWarning"
    ),  # Raised by Overcooked whenever it is built.
]

THEIRS = {
    "overcooked": {"options": "max_steps=8"},
    "HeuristicEnemySMAX": {"options": "scenario=3m, max_steps=8"},
    "MPE_simple_spread_v3": {"options": "max_steps=8"},
    "MPE_simple_speaker_listener_v4": {"options": "max_steps=8"},
}
"""Options by environment. Speaker and listener differ in sizes: they observe 3 and 11 numbers and
have 3 and 5 actions."""
SIZES = {  # Agents, actions, obs, state, steps.
    "overcooked": (2, 6, 4 * 5 * 26, 2 * 4 * 5 * 26, 8),
    "HeuristicEnemySMAX": (3, 5 + 3, 2 * 13 + 3 * 13 + 10, 6 * 12, 9),
    "MPE_simple_spread_v3": (3, 5, 18, 3 * 18, 9),
    "MPE_simple_speaker_listener_v4": (2, 5, 11, 3 + 11, 9),
}


def make(name, **settings):
    return envs_jax.make("jaxmarl", id=name, **THEIRS[name], **settings)


@pytest.fixture(scope="module", params=THEIRS)
def played(request):
    """Convert an environment, and play the same episode in it and in the original."""
    env = make(request.param)
    return SimpleNamespace(env=env, sizes=SIZES[request.param], **_play_both(env))


def _play_both(env):
    """Play random legal actions in a converted environment, and repeat them in the original."""
    source = env.source
    key_reset, *keys = jax.random.split(jax.random.key(5), env.max_steps + 1)

    def ours():
        def step(carry, key):
            env_state, timestep = carry
            key_step, key_action = jax.random.split(key)
            action = envs_jax.random_actions(key_action, timestep.action_mask)
            env_state, timestep = env.step(key_step, env_state, action)
            return (env_state, timestep), (action, timestep)

        start = env.reset(key_reset)
        return start[1], jax.lax.scan(step, start, jnp.stack(keys))[1]

    start, (actions, timesteps) = jax.tree.map(np.asarray, jax.jit(ours)())
    step_env = jax.jit(source.step_env)
    obs, state = jax.jit(source.reset)(key_reset)
    theirs = [(obs, state, None, None)]
    for key, action in zip(keys, actions):
        given = dict(zip(source.agents, action))
        obs, state, rewards, dones, _ = step_env(jax.random.split(key)[0], state, given)
        theirs.append((obs, state, rewards, dones))
    pairs = [start] + [jax.tree.map(lambda x, t=t: x[t], timesteps) for t in range(len(actions))]
    return {"ours": pairs, "theirs": theirs, "actions": actions}


def test_sizes(played):
    env = played.env
    sizes = (env.num_agents, env.num_actions, env.obs_dim, env.state_dim, env.max_steps)
    assert sizes == played.sizes
    assert hash(env) == hash(envs_jax.make("jaxmarl", id=env.id, options=env.options))


def test_numbers_equal_those_of_jaxmarl(played):
    source = played.env.source
    for ours, (obs, _, rewards, dones) in zip(played.ours, played.theirs):
        rows = [np.asarray(obs[agent], np.float32).ravel() for agent in source.agents]
        for index, row in enumerate(rows):
            np.testing.assert_allclose(ours.obs[index, : len(row)], row, rtol=1e-5, atol=1e-6)
            assert not ours.obs[index, len(row) :].any()
        expected = obs.get("world_state", np.concatenate(rows))
        np.testing.assert_allclose(ours.state, expected, rtol=1e-5, atol=1e-6)
        if rewards is not None:
            mean = np.mean([rewards[agent] for agent in source.agents])
            np.testing.assert_allclose(ours.reward, mean, rtol=1e-5, atol=1e-6)
            assert ours.done == dones["__all__"]


def test_legal_actions_equal_those_of_jaxmarl(played):
    source = played.env.source
    for ours, (_, state, _, _) in zip(played.ours, played.theirs):
        for index, agent in enumerate(source.agents):
            count = source.action_space(agent).n
            legal = np.ones(count)
            if "SMAX" in type(source).__name__:
                legal = source.get_avail_actions(state)[agent]
            np.testing.assert_array_equal(ours.action_mask[index, :count], legal)
            assert not ours.action_mask[index, count:].any()


def test_episode_has_as_many_steps_as_in_jaxmarl(played):
    ends = [dones["__all__"].item() for *_, dones in played.theirs[1:]]
    assert ends == [False] * (played.env.max_steps - 1) + [True]
    assert played.ours[-1].truncated
    assert not played.ours[-1].terminated


@pytest.mark.parametrize("name", list(THEIRS)[:3])
def test_check_passes(name):
    check_environment(make(name))


def test_smaller_time_limit_and_sum_of_rewards():
    env = make("MPE_simple_spread_v3", max_steps=3, team_reward="sum")
    episode = _play_both(env)
    assert [ours.truncated.item() for ours in episode["ours"]] == [False, False, False, True]
    for ours, (_, _, rewards, _) in zip(episode["ours"][1:], episode["theirs"][1:]):
        assert ours.reward < 0
        total = sum(rewards[agent] for agent in env.source.agents)
        np.testing.assert_allclose(ours.reward, total, rtol=1e-5)


def test_shaped_reward_coef():
    """Agent 0 has a shaped reward of 3, that of JaxMARL for an onion put into the pot."""
    env = from_jaxmarl(make("overcooked").source, shaped_reward_coef=0.5)
    rewards = {"agent_0": jnp.float32(20), "agent_1": jnp.float32(20)}
    shaped = {"agent_0": jnp.int32(3), "agent_1": jnp.int32(0)}
    assert env._team_reward(rewards, {"shaped_reward": shaped}) == 20 + 0.5 * 3 / 2


@pytest.fixture(scope="module")
def smax():
    env = make("HeuristicEnemySMAX")
    env_state, _ = jax.jit(env.reset)(jax.random.key(0))
    return env_state, jax.jit(env.step)


def stand_still(smax, alive, time):
    """Return the time step of step number `time` with the given units alive, allies first."""
    env_state, step = smax
    units = env_state.state.state
    alive = jnp.array(alive, bool)
    units = units.replace(
        # Units are out of reach of each other and of the walls.
        unit_positions=jnp.array([[2.0, 2.0]] * 3 + [[30.0, 30.0]] * 3),
        unit_alive=alive,
        unit_health=units.unit_health * alive,
        step=units.step + time - 1,
    )
    env_state = env_state._replace(
        state=env_state.state.replace(state=units), time=env_state.time + time - 1
    )
    return step(jax.random.key(1), env_state, jnp.full(3, 4))[1]


@pytest.mark.parametrize(
    ("alive", "time", "terminated", "truncated", "success"),
    [
        ([1, 0, 0, 0, 0, 0], 3, True, False, 1),
        ([0, 0, 0, 0, 1, 0], 3, True, False, 0),
        ([1, 1, 0, 0, 1, 0], 3, False, False, 0),
        ([1, 1, 0, 0, 1, 0], 9, False, True, 0),
        ([1, 0, 0, 0, 0, 0], 9, True, False, 1),  # At the last step.
    ],
)
def test_ends_of_smax(smax, alive, time, terminated, truncated, success):
    timestep = stand_still(smax, alive, time)
    assert timestep.terminated == terminated
    assert timestep.truncated == truncated
    assert timestep.info["success"] == success


MISTAKES = [
    ({"id": "SMAX"}, "id: SMAX is not a team task (enemy_0 opposes the others)"),
    ({"id": "MPE_simple_tag_v3"}, "is not a team task (adversary_0 opposes the others)"),
    ({"id": "coin_game"}, "is not a team task (each agent has its own reward)"),
    (
        {"id": "MPE_simple_spread_v3", "options": "action_type=Continuous"},
        "id: agent_0 of SimpleSpreadMPE acts in a Box space; choose",
    ),
    ({"id": "hanabi"}, "max_steps is missing: HanabiEnv has no time limit of its own; give one"),
    ({"id": "overcookd"}, "id: JaxMARL has no environment 'overcookd' (did you mean overcooked?)"),
    ({"options": "layout=ring"}, "options: overcooked has no layout 'ring' (known: cramped_room,"),
    ({"options": "lives=1"}, "options 'lives=1': overcooked cannot be built: "),
    ({"max_steps": 401}, "max_steps 401 is more than the 400 steps after which Overcooked ends"),
    ({"max_steps": -1}, "max_steps must be at least 1, or 0 for JaxMARL's, got -1"),
    ({"shaped_reward_coef": float("nan")}, "shaped_reward_coef must be finite, got nan"),
    (
        {"id": "MPE_simple_spread_v3", "shaped_reward_coef": 1.0},
        "shaped_reward_coef 1.0: SimpleSpreadMPE has no shaped reward; leave it at 0",
    ),
]


@pytest.mark.parametrize(("settings", "message"), MISTAKES, ids=lambda x: str(x)[:40])
def test_mistakes_are_reported_in_one_line(settings, message):
    with pytest.raises(ValueError) as error:  # noqa: PT011 (the message is compared)
        envs_jax.make("jaxmarl", **settings)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_team_reward_is_one_of_two():
    with pytest.raises(ValueError, match="team_reward must be mean or sum, got 'max'"):
        from_jaxmarl(make("overcooked").source, team_reward="max")


# To JaxMARL


def rollout(env, keys):
    """Play random legal actions.

    Returns:
        The time step at reset, and those of all steps, (steps, ...).
    """

    def step(carry, key):
        env_state, timestep = carry
        key_step, key_action = jax.random.split(key)
        action = envs_jax.random_actions(key_action, timestep.action_mask)
        env_state, timestep = env.step(key_step, env_state, action)
        return (env_state, timestep), timestep

    start = env.reset(keys[0])
    _, timesteps = jax.lax.scan(step, start, keys[1:])
    return start[1], timesteps


OURS = {"alice_and_bob": AliceAndBob(max_steps=30), **{name: PROBES[name]() for name in PROBES}}


@pytest.mark.parametrize("env", OURS.values(), ids=OURS)
def test_there_and_back_is_the_same(env):
    back = from_jaxmarl(to_jaxmarl(env))
    keys = jax.random.split(jax.random.key(2), 1 + env.max_steps)
    expected, got = (jax.jit(partial(rollout, each))(keys) for each in (env, back))
    jax.tree.map(np.testing.assert_array_equal, got, expected)
    assert expected[1].done[-1]
    frame = back.render(back.reset(keys[0])[0])
    np.testing.assert_array_equal(frame, env.render(env.reset(keys[0])[0]))


def test_exported_resets_itself():
    env = to_jaxmarl(PROBES["probe_time_limit"]())  # Two steps, then truncated.
    actions = dict.fromkeys(env.agents, jnp.int32(0))
    step = jax.jit(env.step)
    obs, state = env.reset(jax.random.key(0))
    seen = []
    for key in jax.random.split(jax.random.key(1), 5):
        obs, state, rewards, dones, info = step(key, state, actions)
        seen.append((state.step.item(), dones["__all__"].item(), info["truncated"].tolist()))
        assert rewards == {"agent_0": 1, "agent_1": 1}
        np.testing.assert_array_equal(obs["agent_1"], state.timestep.obs[1])
    running, over = [False] * 2, [True] * 2
    assert seen == [
        (1, False, running),
        (0, True, over),
        (1, False, running),
        (0, True, over),
        (1, False, running),
    ]


def test_exported_has_the_interface_of_jaxmarls_trainers():
    env = to_jaxmarl(PROBES["probe_legal_action"]())
    obs, state = env.reset(jax.random.key(0))
    assert env.agents == ["agent_0", "agent_1"]
    assert (env.num_agents, env.num_allies, env.name) == (2, 2, "LegalAction")
    assert env.observation_space("agent_0").shape == obs["agent_0"].shape == (8,)
    assert env.action_space("agent_1").n == 2
    assert env.world_state_size() == env.state_size == len(obs["world_state"]) == 20
    assert (env.horizon, env.max_steps) == (1, 1)
    legal = env.get_avail_actions(state)
    for index, agent in enumerate(env.agents):
        np.testing.assert_array_equal(legal[agent], np.eye(2)[state.env_state.cue[index]])
