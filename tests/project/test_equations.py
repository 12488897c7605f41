"""docs/equations.md is true: functions and keys exist, values are the paper's and the code's."""

import ast
import dataclasses
import importlib
import inspect
import pkgutil
import re
from itertools import product
from pathlib import Path

import pytest

import hmasd_jax
from hmasd_jax.config import TrainConfig, load
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.rl.ppo import PPOConfig

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "equations.md").read_text()
ALICE = "configs/alice_and_bob/hmasd.toml"

# From the paper; the page and the code are compared with these, not with each other.
TABLE_1 = {
    "training threads": 16, "rollout threads": 32, "hidden size": 64, "use valuenorm": True,
    "use orthogonal": True, "gain": 0.01, "optimizer": "Adam", "optimizer epsilon": 1e-5,
    "weight decay": 0, "ppo epoch": 15, "clip param": 0.2, "num mini batch": 1,
    "value loss coef": 1, "use gae": True, "gae lambda": 0.95, "gamma": 0.99,
    "use huber loss": True, "huber delta": 10,
}  # fmt: skip
TABLE_2 = {
    "Alice_and_Bob": (5e-4, 100, 3e6, 100, 1),
    "SMAC with 0-1 reward": (1e-4, 100, 2e6, 100, 4),
    "Overcooked": (1e-4, 400, 1e7, 32, 8),
}
TABLE_3 = {
    "Alice_and_Bob": (50, 2, 4, 0.1, 0.01, 0, 0.1, 0.2),
    "3m": (25, 3, 3, 0.001, 0.01, 100, 0.1, 0.5),
    "2s_and_1sc": (25, 2, 5, 0.03, 0.01, 100, 0.1, 1),
    "2m_and_1z": (50, 3, 2, 0.005, 0.01, 100, 0.1, 1),
    "cramped_room": (25, 3, 3, 0.01, 0.01, 100, 1, 0.5),
    "asymmetric_advantages": (25, 3, 3, 0.01, 0.01, 100, 0.1, 0.1),
    "coordination_ring": (10, 3, 3, 0.1, 0.01, 100, 0.15, 0.1),
}
ALGORITHM_1 = [
    "Initialize", "for episode", "for t =", "collect s_t", "if t mod k = 0", "sample skills",
    "sample action", "execute joint actions", "compute low-level reward", "into B_l",
    "if t mod k = k - 1", "into B_h", "into D", "by L_h", "by L_l", "by L_d", "random minibatches",
]  # fmt: skip


def _section(title):
    return PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]


def _rows(title):
    """Cells of the section's table, without its head."""
    lines = [line for line in _section(title).splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def _value(cell):
    try:
        return ast.literal_eval(cell)
    except (ValueError, SyntaxError):
        return cell


def _functions():
    """Every function of the package by its full name."""
    found = {}
    for info in pkgutil.walk_packages(hmasd_jax.__path__, "hmasd_jax."):
        if info.name.endswith("__main__"):
            continue
        module = importlib.import_module(info.name)
        for name, value in vars(module).items():
            if inspect.isfunction(value) and value.__module__ == info.name:
                found[f"{info.name}.{name}"] = value
    return found


def _look_up(path):
    """The object at a dotted path, e.g. a method of a class of a module."""
    parts = path.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            value = importlib.import_module(".".join(parts[:cut]))
        except ModuleNotFoundError:
            continue
        for name in parts[cut:]:
            value = getattr(value, name)
        return value
    raise AttributeError(path)


def _setting(config, key):
    for name in key.split("."):
        config = getattr(config, name)
    return config


def _in_backticks(pattern):
    return sorted(set(re.findall(rf"`({pattern})`", PAGE)))


NAMES = _in_backticks(r"(?:hmasd_jax|envs_jax)\.[\w.]+")
KEYS = _in_backticks(r"(?:algorithm|env)\.[\w.]+|total_env_steps|eval_episodes")


@pytest.mark.parametrize("name", NAMES)
def test_everything_named_exists(name):
    assert _look_up(name) is not None


@pytest.mark.parametrize("key", KEYS)
def test_every_key_exists(key):
    _setting(TrainConfig(), key)


def test_the_look_ups_can_fail():
    with pytest.raises(AttributeError):
        _look_up("hmasd_jax.hmasd.rewards.no_such_function")
    with pytest.raises(AttributeError):
        _setting(TrainConfig(), "algorithm.no_such_key")
    assert len(NAMES) > 30
    assert len(KEYS) > 25


def test_every_equation_has_a_row():
    numbers = {row[0] for row in _rows("Equations")}
    assert numbers == {*map(str, range(1, 9)), "r^h"}


@pytest.mark.parametrize(
    ("number", "symbol", "functions"),
    [
        (4, "r^i = lambda_e r", ["hmasd_jax.hmasd.rewards.low_level_reward"]),
        (5, "L", ["hmasd_jax.rl.ppo.policy_loss", "hmasd_jax.rl.ppo.ppo_loss",
                  "hmasd_jax.rl.ppo.value_loss"]),
        (6, "L_h = ", ["hmasd_jax.hmasd.coordinator.coordinator_loss"]),
        (7, "L_l = ", ["hmasd_jax.hmasd.discoverer.discoverer_loss"]),
        (8, "L_d = ", ["hmasd_jax.hmasd.discriminators.discriminator_loss"]),
    ],
)  # fmt: skip
def test_the_functions_of_an_equation_begin_with_it_and_no_others_do(number, symbol, functions):
    begin = [
        name
        for name, function in _functions().items()
        if (function.__doc__ or "").startswith(f"Eq. {number}: {symbol}")
    ]
    assert sorted(begin) == functions
    claims = [n for n, f in _functions().items() if (f.__doc__ or "").startswith(f"Eq. {number}")]
    assert sorted(claims) == functions
    on_the_page = {row[2].strip("`") for row in _rows("Equations") if row[0] == str(number)}
    assert set(functions) <= on_the_page


def test_every_line_of_algorithm_1_has_a_row():
    lines = [row[0] for row in _rows("Algorithm 1")]
    missing = [phrase for phrase in ALGORITHM_1 if not any(phrase in line for line in lines)]
    assert not missing
    assert all(re.fullmatch(r"`hmasd_jax\.[\w.]+`", row[1]) for row in _rows("Algorithm 1"))


def test_table_1_is_the_papers():
    assert {row[0]: _value(row[1]) for row in _rows("Table 1")} == TABLE_1


@pytest.mark.parametrize("row", _rows("Table 1"), ids=lambda row: row[0])
def test_table_1_is_the_default_and_in_the_config(row):
    name, _, where = row
    key = where.strip("`")
    if key.startswith("algorithm."):
        assert _setting(TrainConfig(), key) == TABLE_1[name]
        assert _setting(load(ROOT / ALICE), key) == TABLE_1[name]
        assert getattr(PPOConfig(), key.split(".")[-1]) == TABLE_1[name]
    elif name == "gain":
        assert _look_up(key) == TABLE_1[name]
    else:
        assert where == "not applicable: no threads" or callable(_look_up(key))


@pytest.mark.parametrize(
    ("title", "table"), [("Table 2", TABLE_2), ("Table 3", TABLE_3)], ids=["Table 2", "Table 3"]
)
def test_tables_2_and_3_are_the_papers_and_the_configs(title, table):
    keys, *rows = _rows(title)
    assert {row[0]: tuple(map(_value, row[1:-1])) for row in rows} == table
    for row in rows:
        files = sorted(ROOT.glob(row[-1].strip("`")))
        assert len(files) == (3 if "*" in row[-1] else 1)
        for file, (key, value) in product(files, zip(keys[1:-1], table[row[0]])):
            if key.startswith("`"):
                assert _setting(load(file), key.strip("`")) == value, (file, key)


def test_the_defaults_are_alice_and_bobs_row():
    config = HMASDConfig()
    values = (
        config.skill_interval, config.num_team_skills, config.num_skills,
        config.high_entropy_coef, config.low_entropy_coef, config.extrinsic_coef,
        config.team_intrinsic_coef, config.individual_intrinsic_coef,
    )  # fmt: skip
    assert values == TABLE_3["Alice_and_Bob"]
    assert load(ROOT / ALICE).algorithm == config


@pytest.mark.parametrize("row", _rows("Settings that are in no table"), ids=lambda row: row[0])
def test_the_other_settings_have_the_default_told(row):
    assert _setting(TrainConfig(), row[0].strip("`")) == _value(row[1])


def leaves(settings, path):
    """List the dotted names of all settings below `path`."""
    if not dataclasses.is_dataclass(settings):
        return [path]
    fields = dataclasses.fields(settings)
    return [x for f in fields for x in leaves(getattr(settings, f.name), f"{path}.{f.name}")]


def test_no_setting_of_the_algorithm_is_left_out():
    assert set(leaves(HMASDConfig(), "algorithm")) <= set(KEYS)
