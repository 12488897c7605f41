"""The placement `workers`: seeds over the cores of one machine.

One single-threaded process per core trains one seed after the other. For networks of the paper's
size this is the fastest way to use a CPU. Threads inside one process waste about a quarter of each
core, and vmapping over seeds wastes more. In the other placements, one program trains all seeds;
see `compiled`.
"""

import multiprocessing
import os
import signal
import traceback
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

import jax

from hmasd_jax.config import build, from_json, to_json
from hmasd_jax.runs.folder import available_cores, seed_folder
from hmasd_jax.training.executable_cache import use_cache
from hmasd_jax.training.host_memory import keep_freed, workers_at_once
from hmasd_jax.training.job import ENDS, Event, Job
from hmasd_jax.training.loop import train_seeds
from hmasd_jax.training.signals import hold_signals, take_signals

POLL_SECONDS = 0.5


def worker_cores(num_seeds: int) -> list[int]:
    """Return the cores for the workers of a sweep, as many as the seeds and the memory allow."""
    cores = available_cores()[:num_seeds]
    return cores[: workers_at_once(len(cores))]


@dataclass
class Worker:
    """A process that trains one seed after the other on its own core."""

    process: BaseProcess
    pipe: Connection
    """Sends indices of seeds to the process and receives its events."""
    core: int
    seed: int
    """Index of the seed in training; -1 if there is none."""

    @classmethod
    def start(cls, job: Job, core: int, seed: int) -> "Worker":
        """Start a process and give it its first seed."""
        context = multiprocessing.get_context("spawn")  # a fork would inherit jax's threads
        pipe, other = context.Pipe()
        arguments = (other, job.run, to_json(job.config), job.loggers, core)
        process = context.Process(target=work, args=arguments, name=f"worker on core {core}")
        with hold_signals():
            process.start()
        other.close()  # the pipe then closes when the process ends
        pipe.send(seed)
        return cls(process, pipe, core, seed)

    def assign(self, seed: int | None) -> None:
        """Send the next seed to the worker; None tells it to exit."""
        self.seed = -1 if seed is None else seed
        with suppress(OSError):  # a dead worker is noticed when its pipe is read
            self.pipe.send(seed)


def run_workers(job: Job, indices: list[int], cores: list[int]) -> dict[int, Event]:
    """Train the seeds in one process per core.

    If a worker dies, only its current seed fails, and a new worker replaces it. A worker that alone
    is told to end saves its seed first, and is replaced too.

    Args:
        job: The run to train.
        indices: Indices of the seeds.
        cores: Cores to start workers on.

    Returns:
        The last event of each seed, of kind `finished`, `interrupted` or `failed`.
    """
    waiting = deque(indices)
    workers = [Worker.start(job, core, waiting.popleft()) for core in cores[: len(indices)]]
    try:
        return _serve(job, workers, waiting)
    finally:
        for worker in workers:  # after an error; a worker whose pipe closes saves and stops
            worker.pipe.close()


def _serve(job: Job, workers: list[Worker], waiting: deque[int]) -> dict[int, Event]:
    """Assign the seeds in `waiting` and report all events until no worker is left."""
    results, stopping = {}, False
    while workers:
        for worker in _with_news(workers):
            event = _receive(worker)
            if event is None:  # the process is gone
                workers.remove(worker)
                event = _death(worker) if worker.seed >= 0 else None
                if waiting:
                    workers.append(Worker.start(job, worker.core, waiting.popleft()))
            elif event.kind == "interrupted":
                worker.assign(None)
            elif event.kind in ENDS:
                worker.assign(waiting.popleft() if waiting else None)
            if event is not None:
                job.report(event)
                if event.kind in ENDS:
                    results[event.seed] = event
        if job.should_stop() and not stopping:
            stopping = True
            for index in waiting:
                results[index] = Event("interrupted", index, {})
            waiting.clear()
            for worker in workers:
                with suppress(OSError):
                    worker.pipe.send(None)
    return results


def _with_news(workers: list[Worker]) -> list[Worker]:
    """Return the workers that have sent an event or ended."""
    ready = wait([worker.pipe for worker in workers], timeout=POLL_SECONDS)
    return [worker for worker in workers if worker.pipe in ready]


def _receive(worker: Worker) -> Event | None:
    """Return the next event, or None if the process has ended."""
    try:
        return worker.pipe.recv()
    except (EOFError, OSError):
        worker.process.join()
        return None


def _death(worker: Worker) -> Event:
    """Return the event for the seed that was in training when its worker died."""
    code = worker.process.exitcode or 0
    how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"exited with {code}"
    hint = " (out of memory?)" if code == -signal.SIGKILL else ""
    return Event("failed", worker.seed, {"message": f"its process {how}{hint}"})


def pin(core: int) -> None:
    """Restrict this process to one core and one thread, and make it keep freed memory.

    This has no effect on JAX after its first computation.
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false".strip()
    jax.config.update("jax_platforms", "cpu")
    keep_freed()


def work(pipe: Connection, run: Path, table: dict, loggers: tuple[str, ...], core: int) -> None:
    """Train the seeds that arrive through the pipe, until it sends None or closes.

    This is the main function of a worker process.

    Args:
        pipe: Receives indices of seeds and sends events.
        run: Folder of the run.
        table: Configuration of the run, from `to_json`.
        loggers: Loggers beside the JSON lines.
        core: Core to compute on.
    """
    terminated = take_signals()
    pin(core)
    use_cache()  # The parent has told if there is none.

    def report(event: Event) -> None:
        with suppress(OSError):  # the parent is gone; `poll` then returns True
            pipe.send(event)

    def should_stop() -> bool:
        return terminated() or pipe.poll()

    @cache
    def make_job() -> Job:
        config = from_json(table)
        env, algorithm = build(config)
        return Job(run, config, env, algorithm, loggers, report, should_stop)

    while True:
        try:
            index = pipe.recv()
        except EOFError:
            return
        if index is None:
            return
        if terminated():
            report(Event("interrupted", index, {}))
            continue
        try:
            # An environment that only the parent has registered fails here, as that seed's error.
            train_seeds(make_job(), [index])
        except Exception as error:
            path = seed_folder(run, index) / "error.txt"
            with suppress(OSError):
                path.parent.mkdir(exist_ok=True)
                path.write_text(traceback.format_exc())
            summary = str(error).splitlines()[0] if str(error) else type(error).__name__
            report(Event("failed", index, {"message": f"{summary} (see {path})"}))
