"""One sweep over several processes, say one per node of a cluster, on JAX's own runtime.

Seeds do not talk to each other: each process trains its share on its own cores or accelerators, in
the layout that it would choose alone; processes on the same cores share them out. All write to the
same run folder, which must be on a file system that all of them see. The first process prepares the
folder, shows its own seeds, and sums up when all have ended.
"""

import json
import os
import time
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from hmasd_jax.runs import folder as run_folder
from hmasd_jax.training.loop import Event

POLL_SECONDS = 1.0
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
"""Where Linux says which machine this is, in whatever container."""


class Group(NamedTuple):
    """Which of the processes this is."""

    index: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process prepares and sums up."""
        return self.index == 0

    def share(self, seeds: list[int]) -> list[int]:
        """The seeds of this process."""
        return seeds[self.index :: self.size]

    def follow(self, ok: bool) -> bool:
        """What the leader says, once all processes have come here."""
        if self.size == 1:
            return ok
        from jax.experimental import multihost_utils

        return bool(multihost_utils.broadcast_one_to_all(np.int32(ok), is_source=self.leads))


ALONE = Group()


def join() -> Group:
    """Connect the processes that were started together.

    SLURM, Open MPI and others are recognized by JAX; else three environment variables tell:
    JAX_COORDINATOR_ADDRESS (host:port of the first process), JAX_NUM_PROCESSES, JAX_PROCESS_ID.

    Raises:
        RunError: nothing tells which processes there are, or they do not find each other.
    """
    count, index = (os.environ.get(name) for name in ("JAX_NUM_PROCESSES", "JAX_PROCESS_ID"))
    try:
        jax.distributed.initialize(
            num_processes=None if count is None else int(count),
            process_id=None if index is None else int(index),
        )
    except (ValueError, RuntimeError) as error:
        raise run_folder.RunError(
            f"cannot connect the processes of this sweep: {error}; start it with srun or mpirun, "
            "or set JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID in each process"
        ) from error
    group = Group(jax.process_index(), jax.process_count())
    if hasattr(os, "sched_setaffinity"):
        _divide_cores(group)
    return group


def _divide_cores(group: Group) -> None:
    """Leave each process that was started on the same cores of the same machine some of its own.

    Each would pin its workers to the first of them otherwise. A launcher that gives every process
    cores of its own has done it already: then nothing changes.
    """
    from jax.experimental import multihost_utils

    cores = run_folder.available_cores()
    place = np.uint32(zlib.crc32(f"{BOOT_ID.read_text()} {cores}".encode()))
    places = multihost_utils.process_allgather(place).reshape(-1).tolist()
    os.sched_setaffinity(0, share_of_cores(cores, places, group.index))


def share_of_cores(cores: list[int], places: Sequence[int], index: int) -> list[int]:
    """The cores of process `index` among those at the same place; one at least.

    Args:
        cores: what the processes at its place may use.
        places: of every process, equal where they were started on the same cores.
        index: which process.
    """
    neighbors = [other for other, place in enumerate(places) if place == places[index]]
    turn = neighbors.index(index)
    return cores[turn :: len(neighbors)] or [cores[turn % len(cores)]]


def gather(group: Group, run: Path, results: dict[int, Event]) -> dict[int, Event]:
    """How the seeds ended: of all processes for the leader, of their own for the others.

    Goes by files, as processes may end hours apart; should one die, JAX's runtime ends the others.
    """
    if not group.leads:
        run_folder.write_json(_path(run, group.index), list(results.values()))
        return results
    for index in range(1, group.size):
        while not _path(run, index).exists():
            time.sleep(POLL_SECONDS)
        for kind, seed, data in json.loads(_path(run, index).read_text()):
            results[seed] = Event(kind, seed, data)
        _path(run, index).unlink()
    return results


def forget(group: Group, run: Path) -> None:
    """Remove what an earlier attempt that was not summed up has left."""
    for index in range(1, group.size):
        _path(run, index).unlink(missing_ok=True)


def _path(run: Path, index: int) -> Path:
    return run / f"process_{index}.json"
