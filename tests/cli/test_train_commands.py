import dataclasses
import json
import os
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_jax.alice_and_bob import AliceAndBob
from hmasd_jax.cli.main import main
from hmasd_jax.config import TrainConfig, build, load, to_json
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.runs import checkpoint, metrics_log
from hmasd_jax.runs.folder import (
    LOCK,
    checkpoint_folder,
    create,
    lock,
    metrics_path,
    read_config,
    seeds_of,
)
from hmasd_jax.training import host_memory, loop
from hmasd_jax.training.compiled import seed_key
from hmasd_jax.training.job import Job
from hmasd_jax.training.loop import train_seeds
from hmasd_jax.validation import ConfigError
from tests.helpers import toy
from tests.helpers.toy import SETTINGS, numbers, words


def make_job(run, **more):
    config = load(None, SETTINGS | more)
    create(run, config, [])
    events = []
    return Job(run, config, *build(config), (), events.append, lambda: False), events


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Train seed 1 alone and return its run folder."""
    run = tmp_path_factory.mktemp("alone") / "run"
    assert main(["train", "--run-dir", str(run), "--seed-index", "1", *words()]) == 0
    return run


def test_a_resumed_run_goes_on_with_its_own_seed(alone, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(alone, run)
    more = ["--total-env-steps", str(SETTINGS["total_env_steps"] + 40)]
    assert main(["train", "--run-dir", str(run), "--resume", *more]) == 0
    assert seeds_of(run) == [1]
    assert len(metrics_path(run, 1).read_text()) > len(metrics_path(alone, 1).read_text())


def test_a_run_without_seed_0_must_be_told_which_of_its_seeds_to_resume(alone, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(alone, run)
    shutil.copytree(run / "seed_1", run / "seed_4")
    assert main(["train", "--run-dir", str(run), "--resume"]) == 2
    assert "has the seeds 1, 4: choose one to resume by --seed-index" in capsys.readouterr().err


def test_a_run_folder_holds_everything(alone):
    names = {"config.json", "run.json", "summary.json", "curves.png", "curves.csv", "seed_1", LOCK}
    assert {path.name for path in alone.iterdir()} == names
    assert read_config(alone) == load(None, SETTINGS)
    record = json.loads((alone / "run.json").read_text())
    assert record["command"][1:4] == ["-m", "hmasd_jax.train", "train"]
    assert record["jax"] == jax.__version__
    assert record["device"].startswith("cpu")
    git = ["git", "-C", os.path.dirname(__file__), "rev-parse", "HEAD"]
    head = subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    assert record["commit"].removesuffix("+") == head
    assert checkpoint.steps(alone / "seed_1" / "checkpoints") == [80, 160, 200]
    summary = json.loads((alone / "summary.json").read_text())
    assert summary["seeds"]["1"]["status"] == "finished"
    assert summary["seeds"]["1"]["env_steps"] == 200


def test_records_come_at_their_steps(alone):
    records = metrics_log.read(metrics_path(alone, 1))
    assert {record["seed"] for record in records} == {1}
    steps = [[r["env_steps"] for r in records if r["kind"] == k] for k in ("train", "eval")]
    assert steps == [[40, 80, 120, 160, 200], [0, 80, 160, 200]]
    seconds = [record["wall_seconds"] for record in records]
    assert seconds == sorted(seconds)


def test_training_metrics_are_pooled_over_updates(alone):
    # Update u ends u % 3 episodes, one of them a success if u % 3 == 2. Two updates per line:
    # (1, 2): 3 episodes, 1 success; (3, 4): 0 + 1, none; (5, 6): 2 + 0, 1; (7, 8): 3, 1; (9, 10)
    train = [r for r in metrics_log.read(metrics_path(alone, 1)) if r["kind"] == "train"]
    assert [r["episodes"] for r in train] == [3, 1, 2, 3, 1]
    assert [r["success"] for r in train] == [1 / 3, 0, 1 / 2, 1 / 3, 0]
    # "loss" is the parameters' mean after each update, averaged over the two
    config, (_, algorithm) = (
        load(None, SETTINGS),
        build(load(None, SETTINGS)),
    )
    state = algorithm.init(seed_key(config, 1))
    losses = []
    for _ in range(10):
        state, metrics = algorithm.update(state)
        losses.append(float(metrics["loss"]))
    means = np.reshape(losses, (5, 2)).mean(1)
    np.testing.assert_allclose([r["loss"] for r in train], means, rtol=1e-5)


def test_without_an_episode_there_is_no_success():
    pooled = loop._pool({"episodes": 0.0, "episode_sum/success": 0.0, "loss": 3.0}, 2)
    assert pooled == {"episodes": 0.0, "loss": 1.5}


def test_an_outcome_with_the_name_of_a_metric_keeps_both():
    pooled = loop._pool({"episodes": 2.0, "episode_sum/entropy": 6.0, "entropy": 3.0}, 2)
    assert pooled == {"episodes": 2.0, "episode/entropy": 3.0, "entropy": 1.5}


def test_an_algorithm_that_counts_no_episodes_is_told_so():
    with pytest.raises(ValueError, match=r"update must return the metrics of rl.rollout.rollout_m"):
        loop._pool({"loss": 3.0}, 2)


@pytest.mark.parametrize("placement", ["workers", "vmap", "map", "sharded"])
def test_seed_of_a_sweep_is_the_same_run_as_alone(alone, placement, tmp_path):
    command = [sys.executable, toy.__file__, "seed_sweep", "--run-dir", str(tmp_path / "run")]
    # Two devices for three seeds, so that sharding must pad.
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2"
    env = os.environ | {"XLA_FLAGS": flags}
    done = subprocess.run(
        [*command, *words(placement=placement)], capture_output=True, text=True, env=env
    )
    assert done.returncode == 0, done.stderr
    run = tmp_path / "run"
    assert seeds_of(run) == [0, 1, 2]
    if placement == "workers":
        assert numbers(run, 1) == numbers(alone, 1)
    for ours, theirs in zip(numbers(run, 1), numbers(alone, 1), strict=True):
        assert ours.pop("kind") == theirs.pop("kind")
        assert ours == pytest.approx(theirs, rel=1e-5)
    assert numbers(run, 0)[1]["loss"] != numbers(run, 2)[1]["loss"]
    assert {path.name for path in run.iterdir()} >= {"summary.json", "curves.png", "seed_2"}
    assert "seed 2 finished at env step 200" in done.stdout
    assert "compiled in" in done.stdout


def test_a_resume_that_is_refused_changes_nothing(alone, tmp_path, capsys):
    run = shutil.copytree(alone, tmp_path / "run")
    before = {path: path.read_bytes() for path in run.glob("*.json")}
    command = ["train", "--resume", "--run-dir", str(run), "--seed-index", "1"]
    with lock(run, 1):
        assert main([*command, "--total-env-steps", "400"]) == 2
    assert "another process is training" in capsys.readouterr().err
    assert before == {path: path.read_bytes() for path in run.glob("*.json")}


def test_an_existing_folder_is_not_overwritten(alone, capsys):
    before = numbers(alone, 1)
    assert main(["train", "--run-dir", str(alone), *words()]) == 2
    assert (
        "exists: continue it with --resume, or choose another --run-dir" in capsys.readouterr().err
    )
    assert numbers(alone, 1) == before


@pytest.fixture(scope="module")
def fragile():
    """Return for seeds 0 to 2 whether they turn to NaN at update `explode_at`."""
    config = load(None, SETTINGS)
    _, algorithm = build(config)
    flags = [bool(algorithm.init(seed_key(config, i)).fragile) for i in range(3)]
    assert any(flags)
    assert not all(flags)
    return flags


@pytest.mark.parametrize("together", [True, False])
def test_a_seed_that_is_not_finite_stops_alone(together, fragile, tmp_path):
    job, _ = make_job(tmp_path / "run", **{"algorithm.explode_at": 6})
    groups = [[0, 1, 2]] if together else [[0], [1], [2]]
    results = {}
    for group in groups:
        results |= train_seeds(job, group)
    for seed, is_fragile in enumerate(fragile):
        folder = checkpoint_folder(job.run, seed)
        if not is_fragile:
            assert results[seed].kind == "finished"
            assert checkpoint.latest_step(folder) == 200
            continue
        # Update 6 is in the stretch up to env step 120; the checkpoint at 80 is the last good one.
        assert results[seed].kind == "failed"
        message = results[seed].data["message"]
        assert "not finite in training at env step 120: loss;" in message
        assert message.endswith(f"last good checkpoint: {folder / '80.npz'}")
        assert checkpoint.steps(folder) == [80]
        assert numbers(job.run, seed)[-1]["env_steps"] == 80


class Unmeasured(AliceAndBob):
    """Alice_and_Bob whose success is 0 / 0."""

    def step(self, key, state, action):
        state, timestep = super().step(key, state, action)
        return state, timestep._replace(info=timestep.info | {"success": jnp.nan})


def test_an_evaluation_that_is_not_finite_is_told_by_name(tmp_path):
    job, _ = make_job(tmp_path / "run", **{"env.max_steps": 5})
    job = job._replace(env=Unmeasured(max_steps=5))
    results = train_seeds(job, [0, 1])
    for seed in (0, 1):
        assert results[seed].kind == "failed"
        message = results[seed].data["message"]
        assert message.startswith("not finite in evaluation at env step 0: success; last good")


def test_a_failed_seed_is_told_with_what_to_do(tmp_path, capsys, fragile):
    run = tmp_path / "run"
    index = fragile.index(True)
    more = words(algorithm__explode_at=6)
    assert main(["train", "--run-dir", str(run), "--seed-index", str(index), *more]) == 1
    text = capsys.readouterr().out
    assert f"seed {index} failed: not finite in training at env step 120: loss" in text
    assert f"--run-dir {run} --resume" in text
    assert json.loads((run / "summary.json").read_text())["seeds"][str(index)]["status"] == "failed"


def test_no_two_processes_train_one_seed(tmp_path):
    job, _ = make_job(tmp_path / "run")
    with lock(job.run, 0):
        result = train_seeds(job, [0])[0]
    assert result.kind == "failed"
    assert "another process is training" in result.data["message"]
    assert not metrics_path(job.run, 0).exists()


def test_auto_placement_takes_workers_on_a_cpu():
    config = load(None, SETTINGS)
    assert loop.choose_placement(config) == "workers"
    assert loop.choose_placement(dataclasses.replace(config, placement="vmap")) == "vmap"


def test_auto_placement_takes_all_accelerators(monkeypatch):
    config = load(None, SETTINGS)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert loop.choose_placement(config) == "vmap"
    monkeypatch.setattr(jax, "local_device_count", lambda: 2)
    assert loop.choose_placement(config) == "sharded"


def test_more_seeds_than_fit_into_memory_are_trained_in_batches(alone, tmp_path, monkeypatch):
    job, events = make_job(tmp_path / "run", placement="vmap")
    programs = loop.compiled(job.env, job.algorithm, job.config.eval_episodes, 3, "vmap")
    together = programs.memory_bytes
    monkeypatch.setattr(host_memory, "available_bytes", lambda: together - 1)
    results = train_seeds(job, [0, 1, 2])
    assert [results[seed].kind for seed in range(3)] == ["finished"] * 3
    order = [(event.kind, event.seed) for event in events if event.kind in ("start", "finished")]
    starts = [("start", 0), ("start", 1), ("finished", 0), ("finished", 1), ("start", 2)]
    assert order == [*starts, ("finished", 2)]
    for ours, theirs in zip(numbers(job.run, 1), numbers(alone, 1), strict=True):
        assert ours.pop("kind") == theirs.pop("kind")
        assert ours == pytest.approx(theirs, rel=1e-5)


def test_a_seed_whose_files_cannot_be_used_fails_alone(tmp_path):
    job, _ = make_job(tmp_path / "run", placement="vmap")
    metrics_path(job.run, 1).mkdir(parents=True)
    results = train_seeds(job, [0, 1, 2])
    assert [results[seed].kind for seed in range(3)] == ["finished", "failed", "finished"]
    assert "seed_1" in results[1].data["message"]


def test_a_stop_between_batches_spares_the_seeds_that_wait(tmp_path, monkeypatch):
    job, _ = make_job(tmp_path / "run", placement="vmap", total_env_steps=40)
    monkeypatch.setattr(host_memory, "seeds_at_once", lambda count, _: 2)
    # Before compiling, before the only stretch of seeds 0 and 1, then before seed 2.
    asked = iter([False, False, True])
    results = train_seeds(job._replace(should_stop=lambda: next(asked)), [0, 1, 2])
    assert [results[seed].kind for seed in range(3)] == ["finished", "finished", "interrupted"]
    assert not metrics_path(job.run, 2).exists()


def test_a_stop_spares_groups_that_wait_the_compilation(tmp_path, monkeypatch):
    job, _ = make_job(tmp_path / "run", placement="vmap", total_env_steps=40)
    train_seeds(job, [0])  # Now seeds 1 and 2 form a group of their own, which goes first.
    job, events = make_job(tmp_path / "longer", placement="vmap", total_env_steps=80)
    shutil.copytree(job.run.parent / "run/seed_0", job.run / "seed_0")
    monkeypatch.setattr(loop, "_programs", None)
    results = train_seeds(job._replace(should_stop=lambda: True), [0, 1, 2])
    assert {result.kind for result in results.values()} == {"interrupted"}
    assert "compiling" not in [event.kind for event in events]


def test_tensorboard_files_on_request(tmp_path):
    run = tmp_path / "run"
    assert main(["train", "--tensorboard", "--run-dir", str(run), *words()]) == 0
    (events,) = (run / "seed_0" / "tensorboard").iterdir()
    content = events.read_bytes()
    assert b"train/loss" in content
    assert b"eval/success" in content


def test_types_without_a_name_cannot_be_written_down():
    @dataclasses.dataclass(frozen=True)
    class Unknown:
        ppo: object = dataclasses.field(default_factory=PPOConfig)

    with pytest.raises(ConfigError, match="Unknown is not registered"):
        to_json(TrainConfig(algorithm=Unknown()))
