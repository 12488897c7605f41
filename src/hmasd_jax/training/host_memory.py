"""Memory of the machine: the part of a sweep that fits into it, and settings of malloc."""

import ctypes
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path

import jax

try:
    import resource
except ImportError:  # Windows
    resource = None

WORKER_BYTES = 2 * 2**30
"""Memory set aside for a worker. One worker compiles at a time, which takes HMASD 2.1 to 2.5 GiB.
Those that load its programs take 1.1 GiB."""

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
"""Options of GNU's `mallopt` in <malloc.h>: the free memory at which malloc returns memory to the
system, and the largest number of blocks to request from the system directly."""
GROUP_FILES = {
    "": ("", "memory.max", "memory.current", "inactive_file"),
    "memory": (
        "memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file",
    ),
}  # fmt: skip
"""Files of Linux control groups by the name that /proc/self/cgroup gives the hierarchy, empty in
version 2: its folder, limit, use, and the part of the use that the system can take back."""


def keep_freed() -> None:
    """Make this process keep the memory that it frees, if it uses GNU's C library.

    XLA allocates the temporary arrays of a program at every call. The system clears each page of
    new memory, which takes 3 to 5 % of HMASD's update. The peak grows by 3 % at most.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library
        return
    mallopt(M_TRIM_THRESHOLD, -1)
    mallopt(M_MMAP_MAX, 0)


def predicted_peak(program_bytes: int) -> int:
    """Return the resident memory that this process will reach, in bytes.

    `ps` and `top` call it RSS. It includes Python, JAX and what compilation has taken.

    Args:
        program_bytes: Memory of arguments, results and temporaries of the programs to run. They
            are in this process on a CPU, and on the device otherwise.
    """
    highest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss if resource else 0
    highest *= 1 if sys.platform == "darwin" else 1024  # Bytes there, KiB elsewhere.
    on_host = program_bytes if jax.default_backend() == "cpu" else 0
    return max(highest, _resident_bytes() + on_host)


def _resident_bytes() -> int:
    """Return the memory of this process now; 0 if the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def available_bytes() -> float:
    """Return the free memory of the first local device in bytes; infinity if unknown."""
    device = jax.local_devices()[0]
    stats = device.memory_stats()
    if stats and "bytes_limit" in stats:
        return stats["bytes_limit"] - stats.get("bytes_in_use", 0)
    return available_host_bytes()


def available_host_bytes() -> float:
    """Return the memory of this machine that this process can still take, in bytes.

    A job of a cluster or a container may have less than the machine. Infinity stands for unknown.
    """
    return min(free_bytes_of_machine(), free_bytes_of_groups())


def free_bytes_of_groups(
    groups: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")
) -> float:
    """Return what the memory limits of the control groups leave; infinity without a limit.

    Args:
        groups: File with the groups of this process.
        root: Folder that holds the groups.
    """
    free = math.inf
    try:
        lines = groups.read_text().splitlines()
    except OSError:
        return free
    for line in lines:
        _, hierarchies, name = line.split(":", 2)
        for hierarchy in GROUP_FILES.keys() & hierarchies.split(","):
            top, *files = GROUP_FILES[hierarchy]
            group = root / top / name.lstrip("/")
            # Every group above has a limit, too. Those that a container cannot see are absent.
            for folder in (group, *group.parents):
                if folder.is_relative_to(root / top):
                    free = min(free, _free_bytes_of_group(folder, *files))
    return max(free, 0.0)


def _free_bytes_of_group(folder: Path, limit: str, used: str, inactive: str) -> float:
    """Return the limit of one group less what it uses; infinity if it has none."""
    try:
        most, now = ((folder / name).read_text().strip() for name in (limit, used))
        stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
    except OSError:
        return math.inf
    return math.inf if most == "max" else float(most) - float(now) + float(stat.get(inactive, 0))


def free_bytes_of_machine() -> float:
    """Return the free memory of the machine in bytes; infinity if unknown."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return math.inf
    sizes = {name: amount.split()[0] for name, _, amount in (x.partition(":") for x in lines)}
    return int(sizes["MemAvailable"]) * 1024.0 if "MemAvailable" in sizes else math.inf


def workers_at_once(wanted: int) -> int:
    """Return the number of workers that fit into memory, at least 1 and at most `wanted`."""
    free = available_host_bytes()
    return wanted if free == math.inf else max(1, min(wanted, int(free / WORKER_BYTES)))


def seeds_at_once(num_seeds: int, bytes_needed: Callable[[int], int]) -> int:
    """Return the largest even share of the seeds that fits into memory, at least one seed.

    Args:
        num_seeds: Number of seeds to train.
        bytes_needed: Function from a number of seeds to the memory they need, in bytes. It may be
            slow, so it is called as rarely as possible.
    """
    free, batches = available_bytes(), 1
    while True:
        size = math.ceil(num_seeds / batches)
        if size == 1 or (needed := bytes_needed(size)) <= free:
            return size
        batches = max(batches + 1, math.ceil(batches * needed / max(free, 1)))
