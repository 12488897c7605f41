import dataclasses
import json
from pathlib import Path

import pytest

from envs_jax.registry import ENVIRONMENTS
from hmasd_jax.config import ConfigError, TrainConfig, build, from_json, load, to_json
from hmasd_jax.config.from_table import Flag, Text
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.training.schedule import make_plan

CONFIGS = Path(__file__).parents[2] / "configs"


def test_defaults_are_the_papers_preset():
    """Check that an installed package needs no file."""
    assert load(CONFIGS / "alice_and_bob/hmasd.toml") == TrainConfig() == load()


@pytest.mark.parametrize("path", sorted(CONFIGS.rglob("*.toml")), ids=lambda p: p.stem)
def test_every_shipped_config_loads_and_survives_json(path, tmp_path):
    config = load(path)
    table = to_json(config)
    assert from_json(table) == config
    saved = tmp_path / "config.json"
    saved.write_text(json.dumps(table))
    assert load(saved) == config
    env, algorithm = build(config)
    assert env is config.env
    assert callable(algorithm.update)


@pytest.mark.parametrize("hmasd", sorted(CONFIGS.rglob("hmasd.toml")), ids=lambda p: p.parent.stem)
@pytest.mark.parametrize("baseline", ["mappo", "mat"])
def test_baselines_have_the_task_budget_and_optimization_of_hmasd(hmasd, baseline):
    ours, theirs = (to_json(load(hmasd.with_stem(n))) for n in ("hmasd", baseline))
    assert theirs["algorithm"]["name"] == baseline
    if baseline == "mat":  # MAT has no recurrent memory.
        del ours["algorithm"]["ppo"]["sequence_length"]
        del theirs["algorithm"]["ppo"]["sequence_length"]
    assert theirs["algorithm"]["ppo"] == ours["algorithm"]["ppo"]
    assert theirs | {"algorithm": None} == ours | {"algorithm": None}


def test_overrides_win_over_the_file(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("seed = 3\n[env]\nmax_steps = 7\n[algorithm.ppo]\nnum_envs = 8\n")
    config = load(path, {"algorithm.ppo.num_envs": 4, "env.observation": "one_hot"})
    assert (config.seed, config.env.max_steps, config.env.observation) == (3, 7, "one_hot")
    assert config.algorithm.ppo.num_envs == 4
    assert config.algorithm.ppo.hidden_size == PPOConfig().hidden_size


def test_another_environment_leaves_the_files_settings_of_its_own_behind(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text('[env]\nname = "alice_and_bob"\nobservation = "one_hot"\n')
    names = [n for n in ENVIRONMENTS if n != "alice_and_bob"]
    config = load(path, {"env.name": names[0]})
    assert to_json(config)["env"]["name"] == names[0]
    assert load(path, {"env.name": "alice_and_bob"}).env.observation == "one_hot"


def test_words_are_read_as_their_fields_type():
    config = load(
        None,
        {
            "total_env_steps": Text("3.2e4"),
            "algorithm.ppo.discount": Text("1"),
            "algorithm.zero_reward_guard": Flag("true"),
            "algorithm.skill_prior": Text("False"),
            "env.observation": Text("one_hot"),
        },
    )
    assert config.total_env_steps == 32_000
    assert type(config.total_env_steps) is int
    assert type(config.algorithm.ppo.discount) is float
    assert config.algorithm.zero_reward_guard is True
    assert config.algorithm.skill_prior is False
    assert config.env.observation == "one_hot"


MISTAKES = [
    ({"algorithm.skil_interval": 3}, "unknown key algorithm.skil_interval (did you mean skill_in"),
    ({"algorithm.ppo.num_env": 3}, "unknown key algorithm.ppo.num_env (did you mean num_envs?)"),
    ({"foo": 3}, "unknown key foo (known: env, algorithm, total_env_steps"),
    ({"env.name": "alice"}, "unknown env.name 'alice' (did you mean alice_and_bob?)"),
    ({"algorithm.name": "hamsd"}, "unknown algorithm.name 'hamsd' (did you mean hmasd?)"),
    ({"seed.x": 3}, "seed must be a whole number"),
    ({"env": 3}, "env must be a table"),
    ({"algorithm.ppo": 3}, "algorithm.ppo must be a table"),
    ({"seed": "3"}, "seed must be a whole number, got '3'"),
    ({"algorithm.discriminator_obs": 9}, "must be a list such as [0, 1], got 9"),
    ({"seed": 2.5}, "seed must be a whole number, got 2.5"),
    ({"seed": True}, "seed must be a whole number, got True"),
    ({"seed": Flag("true")}, "seed needs a value"),
    ({"seed": -1}, "seed must be between 0 and 4294967295, got -1"),
    ({"num_seeds": 0}, "num_seeds must be between 1 and 100000, got 0"),
    ({"eval_interval": 0}, "eval_interval must be between 1 and 4611686018427387904, got 0"),
    ({"eval_interval": Text("nan")}, "eval_interval must be a whole number, got nan"),
    (
        {"placement": "wokers"},
        "placement must be one of auto, workers, vmap, map, sharded; got 'wokers' (did you",
    ),
    ({"env.observation": "onehot"}, "env.observation must be one of codes, one_hot; got 'onehot'"),
    ({"env.max_steps": 0}, "env.max_steps must be at least 1, got 0"),
    ({"total_env_steps": 3199}, "total_env_steps 3199 is less than one update takes (3200 ="),
    ({"algorithm.zero_reward_guard": "no"}, "algorithm.zero_reward_guard must be true or false"),
    ({"algorithm.skill_interval": 30}, "algorithm.ppo.rollout_length 100 is not a multiple of"),
    ({"algorithm.num_heads": 3}, "algorithm.num_heads 3 does not divide ppo.hidden_size = 64"),
    ({"algorithm.num_skills": 0}, "algorithm.num_skills must be between 1 and 1024, got 0"),
    ({"algorithm.ppo.num_minibatches": 5}, "algorithm.ppo.num_minibatches 5 does not divide"),
    ({"algorithm.ppo.sequence_length": 7}, "algorithm.ppo.rollout_length 100 is not a multiple"),
    ({"algorithm.ppo.adam_epsilon": 0.0}, "algorithm.ppo.adam_epsilon must be at least 1e-12"),
    ({"algorithm.ppo.max_grad_norm": 0.0}, "algorithm.ppo.max_grad_norm must be at least 1e-12"),
    ({"algorithm.frontier.fade_entropy": True}, "algorithm.frontier.fade_entropy needs coef above"),
    ({"algorithm.ppo.discount": 1.1}, "algorithm.ppo.discount must be between 0 and 1, got 1.1"),
    (
        {"algorithm.ppo.learning_rate": float("nan")},
        "algorithm.ppo.learning_rate must be finite, got nan",
    ),
    ({"algorithm.ppo.learning_rate": -1}, "algorithm.ppo.learning_rate must be at least 0, got -1"),
    (
        {"algorithm.ppo.learning_rate": float("inf")},
        "algorithm.ppo.learning_rate must be finite, got inf",
    ),
]


@pytest.mark.parametrize(("overrides", "message"), MISTAKES, ids=lambda x: str(x)[:40])
def test_a_mistake_is_one_line_that_names_the_field(overrides, message):
    with pytest.raises(ConfigError) as error:
        load(None, overrides)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.toml", "seed = = 3", "a.toml is not valid TOML: Invalid value (at line 1, column 8)"),
        ("a.json", "{", "a.json is not valid JSON: "),
        ("a.toml", "[algorithm]\nname = 3", "unknown algorithm.name 3"),
        ("a.toml", "env = 3", "env must be a table"),
    ],
)
def test_a_bad_file_is_named(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"^[^\n]*$") as error:
        load(path)
    assert message in str(error.value)
    (tmp_path / "hmasd.toml").touch()
    with pytest.raises(ConfigError, match=r"No such file.* \(did you mean hmasd.toml\?\)$"):
        load(tmp_path / "hmasd")
    with pytest.raises(ConfigError, match=r"cannot read config file .*none.toml: No such file"):
        load(tmp_path / "none.toml")


def test_settings_check_themselves_without_a_file():
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        PPOConfig(num_envs=0)
    with pytest.raises(ValueError, match="skill_interval"):
        HMASDConfig(skill_interval=30)
    with pytest.raises(ValueError, match="num_minibatches 4 does not divide"):
        # 2 copies x 100 steps give 40 sequences but only 2 x 100 / 100 segments
        HMASDConfig(skill_interval=100, ppo=PPOConfig(num_envs=2, num_minibatches=4))


def test_plan_of_the_paper():
    # 32 x 100 = 3200 steps per update; 3e6 / 3200 = 937.5; every 80,000 / 3200 = 25 updates
    plan = make_plan(TrainConfig())
    assert (plan.num_updates, plan.env_steps) == (937, 2_998_400)
    assert (plan.log_every, plan.eval_every, plan.checkpoint_every) == (5, 25, 25)
    # at 0, 25, .., 925 and 937
    assert plan.num_evaluations == 1 + 37 + 1


def test_metrics_are_logged_at_every_stop():
    """Check that evaluations and checkpoints fall on ends of stretches, whatever the intervals."""
    base = TrainConfig()
    for eval_interval, log_interval in ((80_000, 30_000), (70_000, 16_000), (1, 10**9)):
        config = dataclasses.replace(base, eval_interval=eval_interval, log_interval=log_interval)
        plan = make_plan(config)
        assert plan.eval_every % plan.log_every == 0
        assert plan.checkpoint_every % plan.log_every == 0
        assert plan.next_stop(0) == plan.log_every
        assert plan.next_stop(plan.num_updates - 1) == plan.num_updates


TOO_DEEP = "[" * 2000
HUGE = "1" * 400
NONSENSE = [
    ("[env]\nname = [1]", "unknown env.name "),
    ("[env.name]\nx = 3", "unknown env.name "),
    (f"seed = {HUGE}", "seed must be between 0 and 4294967295, got 1111"),
    (f"seed = {'1' * 5000}", "is not valid TOML: Exceeds the limit"),
    (
        f"seed = 0x{'f' * 5000}",
        "seed must be between 0 and 4294967295, got a number of many digits",
    ),
    (f"[algorithm.ppo]\nlearning_rate = {HUGE}", "algorithm.ppo.learning_rate must be a number"),
    (f"seed = {TOO_DEEP}", "is not valid TOML: it is nested too deeply"),
    ("num_seeds = 1e30", "num_seeds must be between 1 and 100000, got 1000000"),
    ("eval_episodes = 1e12", "eval_episodes must be between 1 and 1000000, got 1000000000000"),
    ("total_env_steps = 1e30", "total_env_steps must be between 1 and "),
    ("log_interval = 1e30", "log_interval must be between 1 and "),
    ("total_env_steps = 1e18", "total_env_steps 1000000000000000000 takes 312500000000000 updates"),
    ("[env]\nmax_steps = 3000000000", "env.max_steps must be at most 2147483647, got 3000000000"),
    (
        "[algorithm.ppo]\nhidden_size = 1e30",
        "algorithm.ppo.hidden_size must be between 1 and 65536",
    ),
    (
        "[algorithm.ppo]\nnum_envs = 1e10\nnum_minibatches = 7",
        "algorithm.ppo.num_envs must be at most 2147483647, got 10000000000",
    ),
    (
        "[algorithm.ppo]\nnum_envs = 2000000000\nrollout_length = 10",
        "algorithm.ppo.num_envs x rollout_length must be at most 2147483647",
    ),
    (
        "[algorithm.ppo]\nnum_envs = 20000000\nnum_minibatches = 1999999973",
        "algorithm.ppo.num_minibatches 1999999973 does not divide",
    ),
    ("[algorithm.ppo]\nhuber_delta = 1e39", "algorithm.ppo.huber_delta must be at most 3.4e+38"),
    ("[algorithm]\nnum_skills = 1e9", "algorithm.num_skills must be between 1 and 1024"),
    ('"a\\nb" = 3', "unknown key 'a\\nb' (known: env"),
    (f'placement = "{"x" * 10_000}"', "placement must be one of auto, "),
]


@pytest.mark.parametrize(("text", "message"), NONSENSE, ids=lambda x: str(x)[:40])
def test_nonsense_is_one_short_line_at_once(text, message, tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        make_plan(load(path))
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 600


@pytest.mark.parametrize("text", ["[]", "null", "3", '"env"', TOO_DEEP, '{"seed": 1, "seed": 2}'])
def test_a_json_file_that_is_no_table_is_named(text, tmp_path):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"^[^\n]*a.json is [^\n]*$"):
        load(path)


@pytest.mark.parametrize(
    "text",
    ["1\nseed = 3", "1 # a comment", "1, 2", "1,", "", "= 1", "[", TOO_DEEP, HUGE, "1979-05-27"],
)
def test_a_typed_value_is_one_value_and_nothing_else(text):
    with pytest.raises(ConfigError, match=r"^num_seeds must be [^\n]*$"):
        load(None, {"num_seeds": Text(text)})


def test_a_name_of_an_environment_is_no_table():
    with pytest.raises(ConfigError, match=r"unknown env\.name"):
        load(None, {"env.name.x": Text("3")})


def test_a_large_number_means_no_limit():
    assert PPOConfig(max_grad_norm=1e30, huber_delta=1e30).max_grad_norm == 1e30


def test_the_largest_interval_means_never():
    config = load(None, {"eval_interval": 2**62, "log_interval": 2**62})
    plan = make_plan(config)
    assert plan.num_evaluations == 2
    assert plan.next_stop(0) == plan.num_updates
    # The log interval is 5 updates, and 4 divide the longest interval.
    assert make_plan(load(None, {"eval_interval": 2**62})).log_every == 4
