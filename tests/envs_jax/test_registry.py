import subprocess
import sys
from dataclasses import dataclass

import pytest

import envs_jax
from envs_jax import registry
from envs_jax.alice_and_bob import AliceAndBob


@pytest.fixture
def own_names(monkeypatch):
    monkeypatch.setattr(registry, "ENVIRONMENTS", dict(registry.ENVIRONMENTS))


def test_make_overrides_fields():
    assert envs_jax.make("alice_and_bob") == AliceAndBob()
    env = envs_jax.make("alice_and_bob", max_steps=7, observation="one_hot")
    assert env == AliceAndBob(max_steps=7, observation="one_hot")


@pytest.mark.parametrize(
    ("name", "overrides", "message"),
    [
        ("alice_and_bo", {}, "unknown environment 'alice_and_bo' (did you mean alice_and_bob?)"),
        ("tetris", {}, "unknown environment 'tetris' (known: alice_and_bob, "),
        (
            "alice_and_bob",
            {"max_step": 3},
            "alice_and_bob has no field 'max_step' (did you mean max_steps?)",
        ),
        (
            "alice_and_bob",
            {"lives": 3},
            "alice_and_bob has no field 'lives' (known: max_steps, observation)",
        ),
        ("alice_and_bob", {"max_steps": "ten"}, "max_steps must be a whole number, got 'ten'"),
        ("alice_and_bob", {"max_steps": True}, "max_steps must be a whole number, got True"),
        ("overcooked", {"max_steps": 400.0}, "max_steps must be a whole number, got 400.0"),
        ("micro_battle", {"time_limit": "60"}, "time_limit must be a whole number, got '60'"),
        ("probe_time_limit", {"max_steps": None}, "max_steps must be a whole number, got None"),
        (
            "alice_and_bob",
            {"observation": "onehot"},
            "observation must be codes or one_hot, got 'onehot'",
        ),
        ("overcooked", {"random_seats": "no"}, "random_seats must be True or False, got 'no'"),
        ("overcooked", {"layout": 5}, "layout must be a name or lines of text, got 5"),
        ("micro_battle", {"scenario": []}, "scenario [] is unknown (known: 3m, "),
        ("micro_battle", {"time_limit": []}, "time_limit must be a whole number, got []"),
        ("micro_battle", {"scenario": 7}, "scenario 7 is unknown (known: 3m, "),
        (
            "overcooked",
            {"layout": ["XXPXX"]},
            "layout must be a name or lines of text, got ['XXPXX']",
        ),
        ("alice_and_bob", {"max_steps": 0}, "max_steps must be at least 1, got 0"),
        ("probe_delayed_reward", {"max_steps": 1}, "max_steps must be at least 2, got 1"),
    ],
)
def test_make_names_the_mistake(name, overrides, message):
    with pytest.raises(ValueError) as error:  # noqa: PT011 (the whole message is compared)
        envs_jax.make(name, **overrides)
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


@pytest.mark.usefixtures("own_names")
def test_register():
    @dataclass(frozen=True)
    class Mine:
        speed: float = 1.0

    envs_jax.register("mine", Mine)
    envs_jax.register("mine", Mine)  # A second time is allowed, because notebooks run cells twice.
    again = dataclass(frozen=True)(type("Mine", (), {"__qualname__": Mine.__qualname__}))
    assert again.__module__ == Mine.__module__
    envs_jax.register("mine", again)  # So is the class as the cell defines it when run again.
    assert isinstance(envs_jax.make("mine"), again)
    envs_jax.register("mine", Mine)
    assert "mine" in envs_jax.names()
    assert envs_jax.make("mine", speed=2) == Mine(2)
    with pytest.raises(ValueError, match=r"the name 'mine' is already taken by .*Mine; choose"):
        envs_jax.register("mine", AliceAndBob)
    with pytest.raises(ValueError, match="must be a frozen dataclass, got <class 'int'>"):
        envs_jax.register("number", int)
    with pytest.raises(ValueError, match=r"must be a frozen dataclass, got .*Thawed"):
        envs_jax.register("thawed", dataclass(type("Thawed", (), {})))
    with pytest.raises(ValueError, match=r"must be a frozen dataclass, got .*Thawed"):
        envs_jax.register("thawed", dataclass(eq=False)(type("Thawed", (), {})))


def test_package_stands_alone():
    """Importing the package loads neither the trainer nor slow packages, nor starts a device."""
    code = """
import sys, envs_jax, jax
loaded = {"hmasd_jax", "distrax", "flax", "optax", "matplotlib"} & set(sys.modules)
assert not loaded, loaded
assert not jax._src.xla_bridge._backends, "a module-level array was made"
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
