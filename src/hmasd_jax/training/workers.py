"""Seeds over the cores of one machine: the layout `workers`.

One single-threaded process per core trains one seed after the other. At the sizes of the paper this
is the fastest way to use a CPU: threads inside one process waste about a quarter of each core, and
vmapping over seeds costs more still. The other layouts are one program each, see `programs`.
"""

import multiprocessing
import os
import signal
import traceback
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

import jax

from hmasd_jax import config as configs
from hmasd_jax.runs import folder as run_folder
from hmasd_jax.training import host_memory as memory
from hmasd_jax.training.loop import ENDS, Event, Job, choose_layout, train_seeds

POLL_SECONDS = 0.5


def run_sweep(job: Job, indices: list[int]) -> dict[int, Event]:
    """Train the seeds in the layout that the configuration asks for; how each ended."""
    if choose_layout(job.config) != "workers":
        return train_seeds(job, indices)
    return run_workers(job, indices, worker_cores(len(indices)))


def worker_cores(num_seeds: int) -> list[int]:
    """The cores that a sweep of so many seeds gets workers on."""
    cores = run_folder.available_cores()[:num_seeds]
    return cores[: memory.workers_at_once(len(cores))]


@dataclass
class Worker:
    """A process on a core of its own, the pipe to it, and the seed it is at."""

    process: BaseProcess
    pipe: Connection
    core: int
    seed: int

    @classmethod
    def start(cls, job: Job, core: int, seed: int) -> "Worker":
        """Start a process and give it its first seed."""
        context = multiprocessing.get_context("spawn")  # a fork would inherit jax's threads
        pipe, other = context.Pipe()
        arguments = (other, job.run, configs.to_json(job.config), job.extras, core)
        process = context.Process(target=work, args=arguments, name=f"worker on core {core}")
        process.start()
        other.close()  # so that the pipe ends when the process does
        pipe.send(seed)
        return cls(process, pipe, core, seed)

    def assign(self, seed: int | None) -> None:
        """Hand over the next seed; None sends the worker home."""
        self.seed = -1 if seed is None else seed
        with suppress(OSError):  # it may have died: its pipe will say so
            self.pipe.send(seed)


def run_workers(job: Job, indices: list[int], cores: list[int]) -> dict[int, Event]:
    """Deal the seeds out to one process per core.

    A worker that dies takes only its current seed with it; another is started in its place.
    """
    waiting = deque(indices)
    workers = [Worker.start(job, core, waiting.popleft()) for core in cores[: len(indices)]]
    try:
        return _serve(job, workers, waiting)
    finally:
        for worker in workers:  # after an error: at the end of its pipe a worker saves and stops
            worker.pipe.close()


def _serve(job: Job, workers: list[Worker], waiting: deque[int]) -> dict[int, Event]:
    """Hand out the seeds in `waiting`, and pass events on, until no worker is left."""
    results, stopping = {}, False
    while workers:
        for worker in _with_news(workers):
            event = _receive(worker)
            if event is None:  # the process is gone
                workers.remove(worker)
                if worker.seed >= 0:
                    event = _death(worker)
                    if waiting:
                        workers.append(Worker.start(job, worker.core, waiting.popleft()))
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
    """Workers that have sent something or ended."""
    ready = wait([worker.pipe for worker in workers], timeout=POLL_SECONDS)
    return [worker for worker in workers if worker.pipe in ready]


def _receive(worker: Worker) -> Event | None:
    """The next event, None if there will be no more."""
    try:
        return worker.pipe.recv()
    except (EOFError, OSError):
        worker.process.join()
        return None


def _death(worker: Worker) -> Event:
    """The failure of the seed that a worker died at."""
    code = worker.process.exitcode or 0
    how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"exited with {code}"
    hint = " (out of memory?)" if code == -signal.SIGKILL else ""
    return Event("failed", worker.seed, {"message": f"its process {how}{hint}"})


def pin(core: int) -> None:
    """Compute on one core, in one thread, keeping freed memory; before JAX computes anything."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false".strip()
    jax.config.update("jax_platforms", "cpu")
    memory.keep_freed()


def work(pipe: Connection, run: Path, config: dict, extras: tuple[str, ...], core: int) -> None:
    """Train the seeds that come through the pipe, until None or its end comes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which tells us
    pin(core)

    def report(event: Event) -> None:
        with suppress(OSError):  # without a parent nobody listens; `poll` then says to stop
            pipe.send(event)

    job = Job(run, configs.from_json(config), extras, report, should_stop=pipe.poll)
    while True:
        try:
            index = pipe.recv()
        except EOFError:
            return
        if index is None:
            return
        try:
            train_seeds(job, [index])
        except Exception as error:
            path = run_folder.seed_folder(run, index) / "error.txt"
            with suppress(OSError):
                path.write_text(traceback.format_exc())
            summary = str(error).splitlines()[0] if str(error) else type(error).__name__
            report(Event("failed", index, {"message": f"{summary} (see {path})"}))
