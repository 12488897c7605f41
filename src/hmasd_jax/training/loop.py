"""The training loop on the host: compiled updates, with logs and checkpoints between them."""

import math
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hmasd_jax.config import Placement, TrainConfig
from hmasd_jax.runs.checkpoint import CheckpointError, latest_step, state_template
from hmasd_jax.runs.folder import RunError, lock
from hmasd_jax.training import host_memory
from hmasd_jax.training.compiled import Programs, compile_programs, evaluation_key, seed_key
from hmasd_jax.training.job import Event, Job
from hmasd_jax.training.schedule import make_plan
from hmasd_jax.training.seed_run import SeedRun

compiled = lru_cache(maxsize=2)(compile_programs)
"""`compile_programs`, cached for a process that trains one seed after the other."""


def train_seeds(job: Job, indices: list[int]) -> dict[int, Event]:
    """Train seeds in this process, each from its newest checkpoint if it has one.

    All seeds are locked until the last one ends. Seeds that have done the same number of
    environment steps train in lockstep.

    Returns:
        The last event of each seed, of kind `finished`, `interrupted` or `failed`.
    """
    seeds = [SeedRun(job, index) for index in indices]
    template = state_template(job.algorithm)
    groups: dict[int, list[SeedRun]] = {}
    with ExitStack() as locks:
        for seed in seeds:
            with _failing(job.run, [seed]):
                # First the lock: until then another process may save a later checkpoint.
                locks.enter_context(lock(job.run, seed.index))
                env_steps = latest_step(seed.checkpoints) or 0
                if env_steps:  # What cannot be read fails now, not after minutes of compiling.
                    seed.restore(template, env_steps)
                groups.setdefault(env_steps, []).append(seed)
        for env_steps, group in sorted(groups.items()):
            with _failing(job.run, group):
                _train_group(job, group, env_steps)
    return {seed.index: seed.result for seed in seeds if seed.result is not None}


@contextmanager
def _failing(run: Path, seeds: list[SeedRun]) -> Iterator[None]:
    """End seeds as failed if their files cannot be used, and go on."""
    try:
        yield
    except (RunError, CheckpointError) as error:
        message = str(error)
    except OSError as error:
        reason = f"cannot write to {run}: {error.strerror or error}"
        message = f"{reason}; what was saved before stays usable"
    else:
        return
    for seed in seeds:
        seed.end("failed", message=message)


def _train_group(job: Job, seeds: list[SeedRun], env_steps: int) -> None:
    """Train seeds that have all done `env_steps`, as many at once as fit into memory."""
    if env_steps == make_plan(job.config).env_steps:
        for seed in seeds:
            seed.report("start", env_steps=env_steps)
            seed.end("finished", env_steps=env_steps)
        return
    if job.should_stop():
        return _interrupt(seeds, env_steps)
    job.report(Event("compiling", seeds[0].index, {}))
    size = host_memory.seeds_at_once(len(seeds), lambda n: _programs(job, n).memory_bytes)
    for first in range(0, len(seeds), size):
        batch = seeds[first : first + size]
        if first and job.should_stop():
            return _interrupt(seeds[first:], env_steps)
        for seed in batch:
            seed.report("start", env_steps=env_steps)
        programs = _programs(job, size)
        seconds, memory_bytes = programs.compile_seconds, programs.memory_bytes
        for seed in batch:
            seed.report(
                "compiled",
                seconds=seconds,
                memory_bytes=memory_bytes,
                peak_bytes=host_memory.predicted_peak(memory_bytes),
            )
        Batch(job, programs, batch, env_steps).train()


def _interrupt(seeds: list[SeedRun], env_steps: int) -> None:
    """End seeds that have not begun as interrupted, without compiling for them."""
    for seed in seeds:
        seed.end("interrupted", env_steps=env_steps)


def _programs(job: Job, num_seeds: int) -> Programs:
    """Return the programs for at least `num_seeds` seeds in the placement of the run."""
    placement = choose_placement(job.config)
    if placement == "workers" or num_seeds == 1:
        placement = "vmap"
    if placement == "sharded":
        devices = jax.local_device_count()
        num_seeds = -(-num_seeds // devices) * devices
    return compiled(job.env, job.algorithm, job.config.eval_episodes, num_seeds, placement)


def choose_placement(config: TrainConfig) -> Placement:
    """Return the placement of the run, with `auto` replaced by the one that suits this machine."""
    if config.placement != "auto":
        return config.placement
    if jax.default_backend() == "cpu":
        return "workers"
    return "sharded" if jax.local_device_count() > 1 else "vmap"


class Batch:
    """Seeds that train in lockstep. Their states have the seeds on the first axis."""

    def __init__(self, job: Job, programs: Programs, seeds: list[SeedRun], env_steps: int) -> None:
        """Initialize the states, or restore them from the checkpoints of step `env_steps`."""
        self.job, self.programs, self.seeds = job, programs, seeds
        self.plan = make_plan(job.config)
        self.updates = env_steps // self.plan.env_steps_per_update
        # The last seed fills the rows that are left if the programs take more seeds.
        rows = seeds + seeds[-1:] * (programs.num_seeds - len(seeds))
        self.indices = [seed.index for seed in rows]
        if env_steps == 0:
            keys = [seed_key(job.config, index) for index in self.indices]
            self.states = programs.init(jnp.stack(keys))
        else:
            template = state_template(job.algorithm)
            states = [seed.restore(template, env_steps) for seed in rows]
            self.states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)

    @property
    def env_steps(self) -> int:
        """Environment steps that each seed has done."""
        return self.updates * self.plan.env_steps_per_update

    @property
    def running(self) -> list[tuple[int, SeedRun]]:
        """Row and seed of all seeds that have not failed."""
        return [(row, seed) for row, seed in enumerate(self.seeds) if seed.result is None]

    def train(self) -> None:
        """Train to the end, to a stop or until all seeds have failed."""
        for seed in self.seeds:
            with _failing(self.job.run, [seed]):
                seed.open(self.env_steps)
        if self.updates == 0:
            self._evaluate()
        while self.running and self.updates < self.plan.num_updates and not self.job.should_stop():
            self._advance()
            if not self.running:
                return
            if self.plan.is_due(self.plan.eval_every, self.updates):
                self._evaluate()
            if self.plan.is_due(self.plan.checkpoint_every, self.updates):
                self._save()
        finished = self.updates == self.plan.num_updates
        if self.updates and not finished:
            self._save()
        for _, seed in self.running:
            seed.end("finished" if finished else "interrupted", env_steps=self.env_steps)

    def _advance(self) -> None:
        """Run the updates up to the next stop and log their metrics."""
        count = self.plan.next_stop(self.updates) - self.updates
        start = time.perf_counter()
        self.states, sums, healthy = self.programs.advance(self.states, jnp.int32(count))
        healthy = np.asarray(healthy)  # waits for the device
        seconds = time.perf_counter() - start
        self.updates += count
        rate = {"env_steps_per_second": count * self.plan.env_steps_per_update / seconds}
        metrics = _rows(sums)
        for row, seed in self.running:
            if not healthy[row]:
                names = _name_not_finite(metrics[row]) or "a parameter"
                seed.fail(f"not finite in training at env step {self.env_steps}: {names}")
                continue
            with _failing(self.job.run, [seed]):
                seed.write("train", self.env_steps, _pool(metrics[row], count) | rate)

    def _evaluate(self) -> None:
        """Evaluate the current states and log the results."""
        keys = [evaluation_key(self.job.config, index, self.env_steps) for index in self.indices]
        metrics = _rows(self.programs.evaluate(self.states, jnp.stack(keys)))
        for row, seed in self.running:
            if names := _name_not_finite(metrics[row]):
                seed.fail(f"not finite in evaluation at env step {self.env_steps}: {names}")
                continue
            with _failing(self.job.run, [seed]):
                seed.write("eval", self.env_steps, metrics[row])

    def _save(self) -> None:
        """Save a checkpoint of every seed."""
        for row, seed in self.running:
            with _failing(self.job.run, [seed]):
                seed.save(self.env_steps, jax.tree.map(lambda x, row=row: x[row], self.states))


def _rows(metrics: dict[str, jax.Array]) -> list[dict[str, Any]]:
    """Convert arrays over seeds to one dictionary of floats per seed."""
    columns = {name: np.asarray(values).tolist() for name, values in metrics.items()}
    return [dict(zip(columns, row)) for row in zip(*columns.values())]


def _name_not_finite(metrics: dict[str, float]) -> str:
    """Return the names of metrics that are not finite, at most three; empty if all are."""
    names = [name for name, value in metrics.items() if not math.isfinite(value)]
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def _pool(sums: dict[str, float], count: int) -> dict[str, float]:
    """Average the metrics of `count` updates.

    Outcomes of episodes are means over all episodes that ended in these updates, and absent if none
    did. All other metrics are means over the updates. An outcome with the name of one of these gets
    `episode/` before it.

    Raises:
        ValueError: The algorithm does not count its episodes.
    """
    if "episodes" not in sums:
        raise ValueError("update must return the metrics of rl.rollout.rollout_metrics, too")
    episodes = sums["episodes"]
    pooled = {"episodes": episodes}
    for name, value in sums.items():
        if name.startswith("episode_sum/"):
            own = name.removeprefix("episode_sum/")
            if episodes:
                pooled[f"episode/{own}" if own in sums else own] = value / episodes
        elif name != "episodes":
            pooled[name] = value / count
    assert all(map(math.isfinite, pooled.values()))
    return pooled
