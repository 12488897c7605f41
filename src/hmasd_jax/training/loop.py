"""The host side of training: chunks of updates, and what happens between them."""

import math
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hmasd_jax import config as configs
from hmasd_jax.config import Layout, TrainConfig
from hmasd_jax.runs import checkpoint
from hmasd_jax.runs import folder as run_folder
from hmasd_jax.runs import metrics_log as logging
from hmasd_jax.training import host_memory as memory
from hmasd_jax.training.compiled import (
    Programs,
    compile_programs,
    evaluation_key,
    seed_key,
    state_template,
)
from hmasd_jax.training.schedule import Plan, make_plan

ENDS = ("finished", "interrupted", "failed")
compiled = lru_cache(maxsize=2)(compile_programs)
"""A process that trains one seed after the other compiles once."""


class Event(NamedTuple):
    """What a run tells its display."""

    kind: str
    """`start`, `compiled`, `train`, `eval`, or one of `ENDS`."""
    seed: int
    data: dict[str, Any]
    """The record of `train` and `eval`; else numbers, or a `message`."""


class Job(NamedTuple):
    """One run folder and how to treat it."""

    run: Path
    config: TrainConfig
    extras: tuple[str, ...]
    """Of `tensorboard`, `wandb`."""
    report: Callable[[Event], None]
    should_stop: Callable[[], bool]
    """Asked between chunks; training then saves and returns."""


class Seed:
    """Files and clock of one seed of a batch."""

    def __init__(self, job: Job, index: int) -> None:
        """Nothing is opened yet."""
        self.job, self.index = job, index
        self.config = configs.to_json(job.config)
        self.checkpoints = run_folder.checkpoint_folder(job.run, index)
        self.writers: list[logging.Writer] = []
        self.began = 0.0
        """On the clock of this process, moved back by what earlier sessions took."""
        self.result: Event | None = None

    def open(self, env_steps: int) -> None:
        """Open the files to go on from `env_steps` (0: afresh); later records are dropped."""
        path = run_folder.metrics_path(self.job.run, self.index)
        resumed_at = env_steps or -1
        logging.keep_until(path, resumed_at)
        records = logging.read(path)
        self.writers = logging.open_writers(
            self.job.run, self.index, self.config, resumed_at, self.job.extras
        )
        self.began = time.perf_counter() - (records[-1]["wall_seconds"] if records else 0.0)

    def write(self, kind: str, env_steps: int, metrics: dict[str, float]) -> None:
        """Log one record and show it."""
        record = {
            "kind": kind,
            "seed": self.index,
            "env_steps": env_steps,
            "wall_seconds": round(time.perf_counter() - self.began, 3),
            **metrics,
        }
        for writer in self.writers:
            writer.write(record)
        self.job.report(Event(kind, self.index, record))

    def save(self, env_steps: int, state: Any) -> None:
        """Checkpoint the state of this seed."""
        keep = self.job.config.keep_checkpoints
        checkpoint.save(self.checkpoints, env_steps, state, self.config, keep)

    def end(self, kind: str, **data: Any) -> None:
        """Close the files and tell how it ended; later calls do nothing."""
        if self.result is None:
            self.result = Event(kind, self.index, data)
            for writer in self.writers:
                with suppress(OSError):  # what a full disk did not take was complained about
                    writer.close()
            self.job.report(self.result)

    def fail(self, reason: str) -> None:
        """End for a reason found in training."""
        latest = checkpoint.latest_step(self.checkpoints)
        good = "none was saved" if latest is None else str(self.checkpoints / str(latest))
        self.end("failed", message=f"{reason}; last good checkpoint: {good}")


def train_seeds(job: Job, indices: list[int]) -> dict[int, Event]:
    """Train seeds in lockstep in this process, each from its newest checkpoint if it has one.

    Returns:
        How each ended: an event `finished`, `interrupted` or `failed`.
    """
    groups: dict[int, list[Seed]] = {}
    for index in indices:
        latest = checkpoint.latest_step(run_folder.checkpoint_folder(job.run, index))
        groups.setdefault(latest or 0, []).append(Seed(job, index))
    for env_steps, seeds in sorted(groups.items()):
        try:
            with ExitStack() as locks:
                for seed in seeds:
                    locks.enter_context(run_folder.lock(job.run, seed.index))
                _train_group(job, seeds, env_steps)
        except (run_folder.RunError, checkpoint.CheckpointError) as error:
            for seed in seeds:
                seed.end("failed", message=str(error))
        except OSError as error:
            reason = f"cannot write to {job.run}: {error.strerror or error}"
            for seed in seeds:
                seed.end("failed", message=f"{reason}; what was saved before stays usable")
    everyone = [seed for seeds in groups.values() for seed in seeds]
    return {seed.index: seed.result for seed in everyone if seed.result is not None}


def _train_group(job: Job, seeds: list[Seed], env_steps: int) -> None:
    """Train seeds that all stand at `env_steps`, as many at once as fit into memory."""
    plan = make_plan(job.config)
    if env_steps == plan.env_steps:
        for seed in seeds:
            job.report(Event("start", seed.index, {"env_steps": env_steps}))
            seed.end("finished", env_steps=env_steps)
        return
    size = memory.seeds_at_once(len(seeds), lambda n: _programs(job.config, n).memory_bytes)
    for first in range(0, len(seeds), size):
        batch = seeds[first : first + size]
        if first and job.should_stop():
            for seed in batch:
                seed.end("interrupted", env_steps=env_steps)
        else:
            _train_batch(job, plan, batch, size, env_steps)


def _train_batch(job: Job, plan: Plan, seeds: list[Seed], size: int, env_steps: int) -> None:
    """Train up to `size` seeds in lockstep, with the programs for `size`."""
    for seed in seeds:
        job.report(Event("start", seed.index, {"env_steps": env_steps}))
    programs = _programs(job.config, size)
    for seed in seeds:
        numbers = {"seconds": programs.compile_seconds, "memory_bytes": programs.memory_bytes}
        job.report(Event("compiled", seed.index, numbers))
    states = _initial_states(job, programs, _indices(programs, seeds), env_steps)
    for seed in seeds:
        seed.open(env_steps)
    _loop(job, plan, programs, seeds, states, env_steps // plan.env_steps_per_update)


def _programs(config: TrainConfig, num_seeds: int) -> Programs:
    """The programs for at least `num_seeds` seeds in the layout of the run."""
    layout = choose_layout(config)
    if layout == "workers" or num_seeds == 1:
        layout = "vmap"
    if layout == "sharded":
        devices = jax.local_device_count()
        num_seeds = -(-num_seeds // devices) * devices
    return compiled(config, num_seeds, layout)


def _indices(programs: Programs, seeds: list[Seed]) -> list[int]:
    """What the programs compute: the last seed again where they take more than there are."""
    indices = [seed.index for seed in seeds]
    return indices + indices[-1:] * (programs.num_seeds - len(indices))


def choose_layout(config: TrainConfig) -> Layout:
    """What `auto` stands for on this machine."""
    if config.layout != "auto":
        return config.layout
    if jax.default_backend() == "cpu":
        return "workers"
    return "sharded" if jax.local_device_count() > 1 else "vmap"


def _initial_states(job: Job, programs: Programs, indices: list[int], env_steps: int) -> Any:
    """Fresh or restored train states, seeds on the first axis."""
    if env_steps == 0:
        return programs.init(jnp.stack([seed_key(job.config, index) for index in indices]))
    template = state_template(configs.build(job.config)[1])
    folders = [run_folder.checkpoint_folder(job.run, index) for index in indices]
    table = configs.to_json(job.config)
    states = [checkpoint.restore(folder, template, table, env_steps)[0] for folder in folders]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)


def _loop(
    job: Job, plan: Plan, programs: Programs, seeds: list[Seed], states: Any, updates: int
) -> None:
    """Advance to the end, a stop or the failure of all seeds, logging and saving on the way."""
    if updates == 0:
        _evaluate(job, programs, seeds, states, 0)
    while updates < plan.num_updates and not job.should_stop():
        count = plan.next_stop(updates) - updates
        start = time.perf_counter()
        states, sums, healthy = programs.advance(states, jnp.int32(count))
        healthy = np.asarray(healthy)  # waits for the device
        seconds = time.perf_counter() - start
        updates += count
        env_steps = updates * plan.env_steps_per_update
        for seed, row, is_healthy in zip(seeds, _rows(sums), healthy):
            if seed.result is None and not is_healthy:
                seed.fail(f"a loss or parameter was not finite at env step {env_steps}")
            if seed.result is None:
                rate = count * plan.env_steps_per_update / seconds
                seed.write("train", env_steps, _pool(row, count) | {"env_steps_per_second": rate})
        if all(seed.result for seed in seeds):
            return
        if plan.is_due(plan.eval_every, updates):
            _evaluate(job, programs, seeds, states, env_steps)
        if plan.is_due(plan.checkpoint_every, updates):
            _save(seeds, states, env_steps)
    env_steps = updates * plan.env_steps_per_update
    if updates < plan.num_updates:
        if updates:
            _save(seeds, states, env_steps)
        for seed in seeds:
            seed.end("interrupted", env_steps=env_steps)
    for seed in seeds:
        seed.end("finished", env_steps=env_steps)


def _evaluate(job: Job, programs: Programs, seeds: list[Seed], states: Any, env_steps: int) -> None:
    """Evaluate the states as they are now."""
    keys = [evaluation_key(job.config, index, env_steps) for index in _indices(programs, seeds)]
    rows = _rows(programs.evaluate(states, jnp.stack(keys)))
    for seed, row in zip(seeds, rows):
        if seed.result is None:
            seed.write("eval", env_steps, row)


def _save(seeds: list[Seed], states: Any, env_steps: int) -> None:
    for position, seed in enumerate(seeds):
        if seed.result is None:
            seed.save(env_steps, jax.tree.map(lambda x, i=position: x[i], states))


def _rows(metrics: dict[str, jax.Array]) -> list[dict[str, float]]:
    """Arrays over seeds as one dictionary of floats per seed."""
    columns = {name: np.asarray(values).tolist() for name, values in metrics.items()}
    return [dict(zip(columns, row)) for row in zip(*columns.values())]


def _pool(sums: dict[str, float], count: int) -> dict[str, float]:
    """Metrics of a stretch of updates.

    Outcomes of episodes are means over all episodes that ended in it, and absent if none did;
    everything else is a mean over the updates.
    """
    episodes = sums["episodes"]
    pooled = {"episodes": episodes}
    for name, value in sums.items():
        if name.startswith("episode_sum/"):
            if episodes:
                pooled[name.removeprefix("episode_sum/")] = value / episodes
        elif name != "episodes":
            pooled[name] = value / count
    assert all(map(math.isfinite, pooled.values()))
    return pooled
