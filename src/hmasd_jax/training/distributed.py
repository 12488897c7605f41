"""One sweep over several processes, e.g. one per node of a cluster.

Seeds do not communicate. Each process trains its share of them on its own cores or accelerators, in
the placement that it would choose alone. Processes that start on the same cores divide them. All
write to the same run folder, which must be on a file system that all of them can see. The first
process prepares the folder, displays its own seeds, and writes the summary when all have ended.

The processes find each other through JAX's runtime, and leave it before they train. It would end
all of them as soon as one dies, or when one ends five minutes before the others.
"""

import json
import math
import os
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from hmasd_jax.runs.folder import RunError, available_cores, write_json
from hmasd_jax.training.job import Event

POLL_SECONDS = 1.0
GRACE_SECONDS = 60.0
"""Time that the first process, when told to stop, gives the others to save and report."""
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
"""File in which Linux identifies the running machine, also from within a container."""


class Group(NamedTuple):
    """The processes of a sweep, and which of them this one is."""

    index: int = 0
    """Index of this process."""
    size: int = 1
    """Number of processes."""

    @property
    def leads(self) -> bool:
        """True for the process that prepares the run folder and writes the summary."""
        return self.index == 0

    def share(self, seeds: list[int]) -> list[int]:
        """Return the seeds of this process."""
        return seeds[self.index :: self.size]

    def follow(self, ok: bool) -> bool:
        """Wait for all processes and return the leader's `ok`."""
        if self.size == 1:
            return ok
        from jax.experimental import multihost_utils

        return bool(multihost_utils.broadcast_one_to_all(np.int32(ok), is_source=self.leads))


ALONE = Group()
"""The group of a process that trains all seeds."""


def join() -> Group:
    """Connect the processes that were started together.

    JAX recognizes SLURM, Open MPI and others. Without them, three environment variables are needed:
    JAX_COORDINATOR_ADDRESS (host:port of the first process), JAX_NUM_PROCESSES and JAX_PROCESS_ID.

    Raises:
        RunError: The processes are not described, or cannot connect.
    """
    count, index = (os.environ.get(name) for name in ("JAX_NUM_PROCESSES", "JAX_PROCESS_ID"))
    try:
        jax.distributed.initialize(
            num_processes=None if count is None else int(count),
            process_id=None if index is None else int(index),
        )
    except (ValueError, RuntimeError) as error:
        raise RunError(
            f"cannot connect the processes of this sweep: {error}; start it with srun or mpirun, "
            "or set JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID in each process"
        ) from error
    group = Group(jax.process_index(), jax.process_count())
    if hasattr(os, "sched_setaffinity"):
        _divide_cores(group)
    return group


def _divide_cores(group: Group) -> None:
    """Divide the cores among the processes that were started on the same ones.

    Otherwise each process would pin its workers to the first of these cores. Nothing changes if the
    launcher has given every process its own cores.
    """
    from jax.experimental import multihost_utils

    cores = available_cores()
    place = np.uint32(zlib.crc32(f"{BOOT_ID.read_text()} {cores}".encode()))
    places = multihost_utils.process_allgather(place).reshape(-1).tolist()
    os.sched_setaffinity(0, share_of_cores(cores, places, group.index))


def share_of_cores(cores: list[int], places: Sequence[int], index: int) -> list[int]:
    """Return the cores for one of the processes that share them, at least one.

    Args:
        cores: Cores that the process and its neighbors may use.
        places: One number per process. It is equal for processes started on the same cores of the
            same machine.
        index: Index of the process.
    """
    neighbors = [other for other, place in enumerate(places) if place == places[index]]
    turn = neighbors.index(index)
    return cores[turn :: len(neighbors)] or [cores[turn % len(cores)]]


def leave(group: Group) -> None:
    """Disconnect the processes; all must call this. Then the end of one no longer ends others."""
    if group.size > 1:
        jax.distributed.shutdown()


@contextmanager
def telling_failure(group: Group, run: Path, seeds: list[int]) -> Iterator[None]:
    """Tell the leader that an error has ended the training of this process, which then raises it.

    Otherwise the leader would wait for the process without end.
    """
    try:
        yield
    except Exception as error:
        if not group.leads:
            message = (str(error).splitlines() or [type(error).__name__])[0]
            events = [Event("failed", seed, {"message": message}) for seed in seeds]
            write_json(_path(run, group.index), events)
        raise


def gather(
    group: Group,
    run: Path,
    seeds: list[int],
    results: dict[int, Event],
    should_stop: Callable[[], bool],
) -> dict[int, Event]:
    """Collect the last events of the seeds of all processes.

    The processes exchange files, because they may end hours apart.

    Args:
        group: The processes.
        run: Folder of the run.
        seeds: Indices of the seeds of all processes.
        results: Last event of each seed of this process.
        should_stop: Once it returns True, processes that do not report within `GRACE_SECONDS` are
            given up, and their seeds have failed.

    Returns:
        Last event of each seed of all processes for the leader, `results` for the others.
    """
    if not group.leads:
        write_json(_path(run, group.index), list(results.values()))
        return results
    deadline = math.inf
    for index in range(1, group.size):
        while not (path := _path(run, index)).exists() and time.monotonic() < deadline:
            time.sleep(POLL_SECONDS)
            if should_stop():
                deadline = min(deadline, time.monotonic() + GRACE_SECONDS)
        if path.exists():
            events = [Event(kind, seed, data) for kind, seed, data in json.loads(path.read_text())]
            path.unlink()
        else:
            message = f"process {index}, which trains it, has not reported"
            share = group._replace(index=index).share(seeds)
            events = [Event("failed", seed, {"message": message}) for seed in share]
        results = results | {event.seed: event for event in events}
    return results


def forget(group: Group, run: Path) -> None:
    """Delete the files of an earlier sweep that ended before its summary."""
    for index in range(1, group.size):
        _path(run, index).unlink(missing_ok=True)


def _path(run: Path, index: int) -> Path:
    return run / f"process_{index}.json"
