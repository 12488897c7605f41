"""Ranges and lists of values that `--vary` accepts, and those that it refuses."""

import pytest

from hmasd_jax.cli.vary import split_settings
from hmasd_jax.config import load
from hmasd_jax.search.space import (
    Choices,
    Range,
    change,
    count,
    preset_values,
    read_space,
    value_of,
)
from hmasd_jax.validation import ConfigError

PRESET = load()


def read(*vary):
    return read_space(PRESET, split_settings(vary))


def test_ranges_and_lists():
    space = read(
        "algorithm.low-entropy-coef=0.01:0.1:log",
        "algorithm.num_skills=2:5",
        "algorithm.ppo.discount=0:1",
        "algorithm.skill_interval=5,10,25",
    )
    assert space == {
        "algorithm.low_entropy_coef": Range(0.01, 0.1, True),
        "algorithm.num_skills": Range(2, 5, False),
        "algorithm.ppo.discount": Range(0.0, 1.0, False),
        "algorithm.skill_interval": Choices(("5", "10", "25")),
    }
    kinds = [type(part.low) for part in space.values() if isinstance(part, Range)]
    assert kinds == [float, int, float]
    assert count(space) == float("inf")
    assert count(read("algorithm.num_skills=2:5", "algorithm.skill_interval=5,10,25")) == 12


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ([], "--vary must name a setting and its range"),
        (["algorithm.low_entropy_coef"], "must name a setting and its values"),
        (["algorithm.low_entropy_coef=0.1"], "write a range as LOW:HIGH"),
        (["algorithm.low_entropy_coef=0.1:1:linear"], "write a range as LOW:HIGH"),
        (["algorithm.low_entropy_coef=0.1:1:log:2"], "write a range as LOW:HIGH"),
        (["algorithm.low_entropy_coef=1:0.1"], "LOW must be below HIGH"),
        (["algorithm.low_entropy_coef=1:1"], "LOW must be below HIGH"),
        (["algorithm.low_entropy_coef=0:1:log"], "must begin above 0"),
        (["algorithm.low_entropy_coef=:1"], "low_entropy_coef must be a number"),
        (["algorithm.low_entropy_coef=-1:1"], "low_entropy_coef must be at least 0"),
        (["algorithm.num_skills=2:4.5"], "num_skills must be a whole number, got 4.5"),
        (["algorithm.num_skills=0:4"], "num_skills must be between 1"),
        (["algorithm.num_skils=2:4"], "did you mean num_skills?"),
        (["algorithm.name=hmasd,mappo"], "each has settings of its own; search them one by one"),
        (["algorithm.ppo=2:4"], "algorithm.ppo must be a table"),
        (["env.observation=a:b"], "env.observation must be one of"),
        (["algorithm.ppo.bootstrap_truncation=0:1"], "bootstrap_truncation must be true or false"),
        (["algorithm.skill_interval=25,0"], "skill_interval must be at least 1"),
        (["algorithm.num_skills=2:4", "algorithm.num-skills=3,4"], "num_skills twice"),
        (["total_env_steps=1:2"], "only settings of env and algorithm can be searched"),
    ],
)  # fmt: skip
def test_anything_else_is_one_clear_error(vary, message):
    with pytest.raises(ConfigError) as error:
        read(*vary)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_the_preset_has_values_in_its_space_or_none():
    own = value_of(PRESET, "algorithm.num_skills")
    inside = read(f"algorithm.num_skills=1:{own}", f"algorithm.skill_interval={25},{50.0}")
    assert preset_values(PRESET, inside) == {
        "algorithm.num_skills": own,
        "algorithm.skill_interval": "50.0",
    }
    assert preset_values(PRESET, read(f"algorithm.num_skills={own + 1}:{own + 2}")) is None
    assert preset_values(PRESET, read("algorithm.skill_interval=10,25")) is None


def test_values_become_a_configuration():
    changed = change(PRESET, {"algorithm.low_entropy_coef": 0.03, "algorithm.skill_interval": "25"})
    assert changed.algorithm.low_entropy_coef == 0.03
    assert changed.algorithm.skill_interval == 25
    assert changed.algorithm.num_skills == PRESET.algorithm.num_skills
