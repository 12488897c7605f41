"""Environments and algorithms that the library does not know yet, as Python code adds them."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from envs_jax import registry
from envs_jax.alice_and_bob import AliceAndBob
from hmasd_jax.algorithms import ALGORITHMS, AlgorithmEntry
from hmasd_jax.config import ConfigError, TrainConfig, build, from_json, to_json
from hmasd_jax.hmasd.algorithm import make_hmasd
from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.rl.ppo import PPOConfig


@dataclass(frozen=True)
class MyConfig(HMASDConfig):
    """Settings of an ablation."""


@dataclass(frozen=True)
class MyGame(AliceAndBob):
    """An environment with a file of its own."""

    goals_file: Path = Path("goals.txt")
    notes: Any = None


@pytest.fixture
def own_names(monkeypatch):
    for names in (registry.ENVIRONMENTS, ALGORITHMS):
        monkeypatch.setitem(names, "mine", None)
        del names["mine"]  # After the test it is gone again.


@pytest.mark.usefixtures("own_names")
def test_a_class_of_settings_names_one_algorithm():
    made = []
    ALGORITHMS["mine"] = AlgorithmEntry(MyConfig, lambda *parts: made.append(parts))
    config = from_json({"algorithm": {"name": "mine"}})
    build(config)
    assert made == [(AliceAndBob(), MyConfig())]
    assert to_json(config)["algorithm"]["name"] == "mine"

    ALGORITHMS["mine"] = AlgorithmEntry(HMASDConfig, make_hmasd)
    message = "HMASDConfig belongs to hmasd and mine, so it names neither: give each a class of"
    for name in ("hmasd", "mine"):
        with pytest.raises(ConfigError, match=message):
            from_json({"algorithm": {"name": name}})
    with pytest.raises(ConfigError, match=message):
        build(TrainConfig())


def test_classes_that_are_not_registered_are_told_where_to_be():
    with pytest.raises(ConfigError, match=r"MyGame is not registered; register your own with envs"):
        to_json(TrainConfig(env=MyGame()))
    with pytest.raises(ConfigError, match=r"MyConfig is not registered; add your own to hmasd_jax"):
        build(TrainConfig(algorithm=MyConfig()))
    with pytest.raises(ConfigError, match=r"\); add your own to hmasd_jax.algorithms"):
        from_json({"algorithm": {"name": "zzz"}})
    with pytest.raises(ConfigError, match=r"jaxmarl\); register your own with envs_jax.regis"):
        from_json({"env": {"name": "zzz"}})
    with pytest.raises(ConfigError, match=r"\(did you mean hmasd\?\)$"):
        from_json({"algorithm": {"name": "hmsd"}})


def test_settings_without_a_rollout_name_what_they_lack():
    with pytest.raises(
        ValueError, match="num_envs and rollout_length, and PPOConfig has none: add"
    ):
        TrainConfig(algorithm=PPOConfig())


@pytest.mark.usefixtures("own_names")
def test_a_path_is_a_setting_and_an_object_is_none():
    registry.register("mine", MyGame)
    table = to_json(TrainConfig(env=MyGame(goals_file=Path("a/b.txt"))))
    assert json.loads(json.dumps(table)) == table
    assert from_json(table).env == MyGame(goals_file=Path("a/b.txt"))
    with pytest.raises(ConfigError, match=r"env.notes cannot be written to config.json: <object"):
        to_json(TrainConfig(env=MyGame(notes=object())))


@pytest.mark.parametrize(
    ("build_it", "message"),
    [
        (lambda: PPOConfig(num_envs=8.0), "num_envs must be int, got 8.0"),
        (lambda: PPOConfig(num_envs="8"), "num_envs must be int, got '8'"),
        (lambda: PPOConfig(num_envs=True), "num_envs must be int, got True"),
        (lambda: PPOConfig(learning_rate="fast"), "learning_rate must be float, got 'fast'"),
        (lambda: HMASDConfig(ppo={"num_envs": 8}), "ppo must be PPOConfig, got {'num_envs': 8}"),
        (
            lambda: HMASDConfig(segment_clock="epsiode"),
            "segment_clock must be rollout or episode, got 'epsiode'",
        ),
        (
            lambda: HMASDConfig(discriminator_obs=[0, 1]),
            r"discriminator_obs must be tuple\[int, ...\], got \[0, 1\]",
        ),
        (lambda: ALGORITHMS["ippo"].config(critic_input="state"), "critic_input must be obs, got"),
        (lambda: ALGORITHMS["maser"].config(variant="mine"), "variant must be released or paper"),
        (lambda: TrainConfig(total_env_steps=3e6), "total_env_steps must be int, got 3000000.0"),
    ],
)
def test_a_value_of_another_type_is_refused_in_python(build_it, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        build_it()


def test_a_whole_number_is_a_float():
    assert PPOConfig(learning_rate=1).learning_rate == 1
