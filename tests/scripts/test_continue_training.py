"""The script that goes on from a checkpoint, with an algorithm that counts its updates."""

from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import pytest

from hmasd_jax import config as configs
from scripts import continue_training as script
from tests.helpers.runs import write_run


class Counted(NamedTuple):
    key: jax.Array
    num_updates: jax.Array


def counting(gain: float) -> SimpleNamespace:
    """Return an algorithm that wins `gain` times its number of updates, and as often by chance."""

    def update(state: Counted) -> tuple[Counted, dict]:
        key, key_win = jax.random.split(state.key)
        wins = gain * state.num_updates + gain * jax.random.uniform(key_win)
        metrics = {"episodes": jnp.float32(20), "episode_sum/success": wins}
        return Counted(key, state.num_updates + 1), metrics

    return SimpleNamespace(update=update)


def test_success_is_pooled_and_repetitions_draw_other_numbers(monkeypatch, tmp_path):
    run = write_run(tmp_path / "run", [[0.0]])
    loaded = SimpleNamespace(state=Counted(jax.random.key(0), jnp.int32(0)))
    monkeypatch.setattr(script, "load_run", lambda *_: loaded)
    monkeypatch.setattr(
        configs,
        "build",
        lambda config: (None, counting(config.algorithm.solved.coordinator_step_factor)),
    )
    settings = {"algorithm.solved.coordinator_step_factor": 0.5, "algorithm.frontier.coef": 1.0}
    rows = script.continue_training(run, 0, 0, settings, num_updates=10, repetitions=2)
    assert [row["repetition"] for row in rows] == [0, 1]
    # 0 + .. + 4 updates make 5 wins of 100, 5 + .. + 9 make 17.5; chance adds up to 2.5.
    for row in rows:
        assert 5 < row["success"][0] < 7.5
        assert 17.5 < row["success"][1] < 20
    assert rows[0]["success"] != rows[1]["success"]


def test_a_task_without_success_has_the_team_reward():
    pooled = script.score({"team_reward": jnp.array([0.25, 0.75]), "episodes": jnp.zeros(2)})
    assert pooled == {"team_reward": 0.5}


def test_updates_without_an_end_of_an_episode_have_no_success(monkeypatch, tmp_path):
    run = write_run(tmp_path / "run", [[0.0]])
    loaded = SimpleNamespace(state=Counted(jax.random.key(0), jnp.int32(0)))
    monkeypatch.setattr(script, "load_run", lambda *_: loaded)
    endless = SimpleNamespace(
        update=lambda state: (state, {"episodes": jnp.float32(0), script.SUCCESS: jnp.float32(0)})
    )
    monkeypatch.setattr(configs, "build", lambda config: (None, endless))
    (row,) = script.continue_training(run, 0, 0, {}, num_updates=5, repetitions=1)
    assert row["success"] == [None]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--updates", "9"], "--updates 9 is not a multiple of 5"),
        (["--updates", "0"], "--updates 0 is not a multiple of 5"),
        (["--set", "num_skills"], "write NAME=VALUE, got 'num_skills'"),
    ],
)
def test_arguments_that_mean_nothing_are_refused(words, message, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["continue_training.py", "run", "out", "--step", "3", *words])
    with pytest.raises(SystemExit):
        script.main()
    assert message in capsys.readouterr().err
