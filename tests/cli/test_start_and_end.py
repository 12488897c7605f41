"""Texts at the start and at the end of training."""

from pathlib import Path

import pytest

from hmasd_jax.cli.main import main
from hmasd_jax.cli.train_commands import describe, next_step
from hmasd_jax.config import load
from hmasd_jax.runs.folder import create
from tests.helpers.toy import words


def test_a_finished_run_ends_with_its_plot_and_a_next_step(tmp_path, capsys):
    assert main(["train", "--run-dir", str(tmp_path / "run"), *words(total_env_steps=40)]) == 0
    lines = capsys.readouterr().out.splitlines()
    (compiling,) = [line for line in lines if line.startswith("compiling, which takes minutes")]
    assert lines.index(compiling) < lines.index("seed 0: fresh")
    render = f"python -m hmasd_jax.train render {tmp_path}/run"
    assert lines[-2:] == [
        f"curves: {tmp_path}/run/curves.png",
        f"see what was learned: {render} --out episode.gif",
    ]


@pytest.mark.parametrize(
    ("algorithm", "seed", "end"),
    [
        ("hmasd", 0, "see what the skills do: {} --team-skill 0 --out skill_0.gif"),
        ("mappo", 3, "see what was learned: {} --seed-index 3 --out episode.gif"),
    ],
)
def test_the_next_step_is_a_command_for_this_run(algorithm, seed, end, tmp_path):
    create(tmp_path / "a run", load(None, {"algorithm.name": algorithm}), [])
    (tmp_path / "a run" / f"seed_{seed}").mkdir()
    command = f"python -m hmasd_jax.train render '{tmp_path}/a run'"
    assert next_step(tmp_path / "a run") == end.format(command)


def test_what_follows_is_told_at_the_start(tmp_path, capsys):
    command = ["train", "--run-dir", str(tmp_path / "run")]
    assert main([*command, *words(total_env_steps=210)]) == 0
    text = capsys.readouterr().out
    assert "updates          10 of 20 env steps" in text
    assert "evaluations      4 of 5 episodes, every 80 env steps" in text
    assert "total_env_steps 210 is rounded down to 200, a multiple of the 20 env steps" in text
    assert "predicted memory" in text


@pytest.mark.parametrize(
    ("config", "warned"),
    [
        (load(overrides={"env.name": "overcooked"}), True),
        (load(overrides={"env.name": "overcooked", "algorithm.extrinsic_coef": 1}), False),
        (load(overrides={"env.name": "overcooked", "algorithm.name": "mappo"}), False),
        (load(), False),
    ],
)
def test_a_low_level_without_the_team_reward_is_told_beyond_its_task(config, warned):
    text = describe(config, [0], Path("run"), "vmap")
    assert ("algorithm.extrinsic_coef is 0" in text) is warned
