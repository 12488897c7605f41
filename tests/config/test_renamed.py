"""Former names of settings are read in every place, and never beside the new ones."""

import dataclasses
import json

import pytest

from hmasd_jax.config import (
    RENAMED,
    ConfigError,
    TrainConfig,
    change,
    from_json,
    identity,
    load,
    to_json,
)
from hmasd_jax.config.presets import find_preset

BOTH = r"^layout is the former name of placement: give only placement$"


def test_new_names_are_settings_and_former_ones_are_not():
    names = {field.name for field in dataclasses.fields(TrainConfig)}
    assert names >= set(RENAMED.values())
    assert not names & set(RENAMED)
    assert not set(to_json(TrainConfig())) & set(RENAMED)


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_a_file_may_have_the_former_name(suffix, tmp_path):
    path = tmp_path / f"config{suffix}"
    path.write_text('layout = "map"' if suffix == ".toml" else '{"layout": "map"}')
    assert load(path).placement == "map"
    assert load(path, {"seed": 3}).placement == "map"


@pytest.mark.parametrize("given", RENAMED | {"placement": "placement"})
@pytest.mark.parametrize("saved", RENAMED | {"placement": "placement"})
def test_the_command_line_wins_over_the_file_under_either_name(saved, given, tmp_path):
    path = tmp_path / "config.json"
    path.write_text(json.dumps({saved: "map"}))
    assert load(path, {given: "vmap"}).placement == "vmap"
    assert change(load(path), {given: "vmap"}).placement == "vmap"


def test_the_kitchen_of_overcooked_keeps_its_name():
    kitchen = {"env.name": "overcooked", "env.layout": "coordination_ring"}
    config = load(None, {**kitchen, "layout": "map"})
    assert (config.env.layout, config.placement) == ("coordination_ring", "map")
    assert load(None, {**kitchen, "placement": "map"}) == config
    assert identity(to_json(config))["env.layout"] == "coordination_ring"
    with pytest.raises(ConfigError, match=r"unknown key env\.placement"):
        load(None, {"env.name": "overcooked", "env.placement": "map"})


def test_both_names_at_once_are_refused(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text('layout = "map"\nplacement = "map"')
    with pytest.raises(ConfigError, match=BOTH):
        load(path)
    both = {"layout": "map", "placement": "map"}
    with pytest.raises(ConfigError, match=BOTH):
        load(None, both)
    with pytest.raises(ConfigError, match=BOTH):
        from_json(both)


def test_an_old_configuration_is_the_same_run():
    table = to_json(TrainConfig())
    old = {**table, "layout": table["placement"]}
    del old["placement"]
    assert from_json(old) == TrainConfig()
    assert identity(old) == identity(table)
    assert find_preset(old) == find_preset(table)


@pytest.mark.parametrize("near", ["placment", "placements", "plaecment"])
def test_a_near_miss_is_told_the_new_name(near):
    with pytest.raises(ConfigError, match=rf"unknown key {near} \(did you mean placement\?\)"):
        load(None, {near: "map"})


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("hmasd", "solved_step_factor", "coordinator_step_factor"),
        ("hmasd", "solved_low_step_factor", "step_factor"),
        ("mappo", "solved_step_factor", "step_factor"),
        ("ippo", "solved_step_factor", "step_factor"),
    ],
)
def test_settings_of_solved_tasks_are_read_by_their_former_names(name, old, new, tmp_path):
    path = tmp_path / "config.json"
    algorithm = {"name": name, old: 0.25, "frontier": {"coef": 1.0}}
    path.write_text(json.dumps({"algorithm": algorithm}))
    assert getattr(load(path).algorithm.solved, new) == 0.25
    assert identity({"algorithm": algorithm})[f"algorithm.solved.{new}"] == 0.25
    path.write_text(json.dumps({"algorithm": algorithm | {"solved": {new: 0.25}}}))
    match = rf"^algorithm.{old} is the former name of algorithm.solved.{new}: give only"
    with pytest.raises(ConfigError, match=match):
        load(path)
