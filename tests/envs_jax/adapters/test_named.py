"""JaxMARL's environments by name, and the errors if an optional package is missing."""

import sys

import pytest

import envs_jax
from envs_jax import MissingPackageError
from envs_jax.adapters.jaxmarl_named import _parse, check_options
from envs_jax.alice_and_bob import AliceAndBob
from hmasd_jax import config as configs
from hmasd_jax.validation import ConfigError


@pytest.fixture
def absent(monkeypatch):
    for package in ("jaxmarl", "pettingzoo"):
        monkeypatch.setitem(sys.modules, package, None)


def test_options_are_parsed():
    assert _parse("") == {}
    assert _parse("layout=coord_ring") == {"layout": "coord_ring"}
    text = "max_steps = 50, local_ratio=0.5,walls_cause_death=false , action_type=Discrete"
    expected = {
        "max_steps": 50,
        "local_ratio": 0.5,
        "walls_cause_death": False,
        "action_type": "Discrete",
    }
    assert _parse(text) == expected
    for wrong in ("layout", "=3", "layout=", "a=1, b"):
        with pytest.raises(ValueError, match=r'options must be written "name=value, name=value"'):
            _parse(wrong)


class Simple:
    """Like JaxMARL's SimpleMPE, which looks some options up and ignores all others."""

    def __init__(self, num_agents=1, dim_c=0, **kwargs):
        self.damping = kwargs.get("damping", 0.25)


class Spread(Simple):
    def __init__(self, num_agents=3, local_ratio=0.5, **kwargs):
        super().__init__(num_agents, **kwargs)


class Heuristic:
    """Like JaxMARL's HeuristicEnemySMAX, which passes options to the environment it wraps."""

    def __init__(self, attack_mode="closest", **env_kwargs):
        self._env = Spread(**env_kwargs)


@pytest.mark.parametrize("make", [Simple, Spread, Heuristic])
def test_an_option_that_is_ignored_is_refused(make):
    check_options("it", make(num_agents=2, dim_c=1), ["num_agents", "dim_c"])
    with pytest.raises(ValueError, match=r"it has no option 'num_agnts' \(did you mean num_"):
        check_options("it", make(num_agnts=2), ["num_agnts"])


def test_options_that_a_constructor_looks_up_or_passes_on_are_known():
    check_options("it", Spread(local_ratio=0.1, damping=0.5), ["local_ratio", "damping"])
    check_options("it", Heuristic(attack_mode="x", local_ratio=0.1), ["attack_mode", "local_ratio"])


@pytest.mark.usefixtures("absent")
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: envs_jax.make("jaxmarl", id="never_made"),
            "id never_made needs the package jaxmarl: "
            "uv pip install -c constraints.txt -e '.[compare]'",
        ),
        (
            lambda: envs_jax.to_jaxmarl(AliceAndBob()),
            "to_jaxmarl needs the package jaxmarl: "
            "uv pip install -c constraints.txt -e '.[compare]'",
        ),
        (
            lambda: envs_jax.to_pettingzoo(AliceAndBob()),
            "to_pettingzoo needs the package pettingzoo: "
            "uv pip install -c constraints.txt -e '.[pettingzoo]'",
        ),
    ],
)
def test_missing_package_error_names_the_remedy(call, message):
    with pytest.raises(MissingPackageError) as error:
        call()
    assert str(error.value) == message


@pytest.mark.usefixtures("absent")
def test_missing_package_is_a_config_error():
    with pytest.raises(ConfigError) as error:
        configs.load(None, {"env.name": "jaxmarl", "env.id": "never_made"})
    assert str(error.value).startswith(
        "env.id never_made needs the package jaxmarl: uv pip install"
    )
