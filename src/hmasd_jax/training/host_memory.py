"""How much of a sweep fits into memory at once, and how a worker holds on to its own."""

import ctypes
import math
from collections.abc import Callable
from pathlib import Path

import jax

WORKER_BYTES = 2 * 2**30
"""What a worker holds at its peak, while it compiles (1.9 GiB measured for HMASD)."""

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
"""Of <malloc.h>: how much free memory goes back to the system, and how many blocks bypass it."""


def keep_freed() -> None:
    """Make this process keep the memory that it frees, where it uses GNU's C library.

    XLA asks for a program's temporary arrays at every call, and fresh memory from the system comes
    page by page, each cleared: 3 to 5 % of HMASD's update. The peak grows by 3 % at most.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library
        return
    mallopt(M_TRIM_THRESHOLD, -1)
    mallopt(M_MMAP_MAX, 0)


def available_bytes() -> float:
    """Memory that is still free on the first local device; infinite where nobody tells."""
    device = jax.local_devices()[0]
    stats = device.memory_stats()
    if stats and "bytes_limit" in stats:
        return stats["bytes_limit"] - stats.get("bytes_in_use", 0)
    return available_host_bytes()


def available_host_bytes() -> float:
    """Memory of this machine that is not in use; infinite where the system does not tell."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return math.inf
    sizes = {name: amount.split()[0] for name, _, amount in (x.partition(":") for x in lines)}
    return int(sizes["MemAvailable"]) * 1024.0 if "MemAvailable" in sizes else math.inf


def workers_at_once(wanted: int) -> int:
    """How many of the workers wanted fit into memory; at least one."""
    free = available_host_bytes()
    return wanted if free == math.inf else max(1, min(wanted, int(free / WORKER_BYTES)))


def seeds_at_once(num_seeds: int, bytes_needed: Callable[[int], int]) -> int:
    """The largest even share of the seeds that fits into memory; at least one.

    Args:
        num_seeds: seeds that would like to be trained at once.
        bytes_needed: what so many seeds need; asked as rarely as possible.
    """
    free, batches = available_bytes(), 1
    while True:
        size = math.ceil(num_seeds / batches)
        if size == 1 or (needed := bytes_needed(size)) <= free:
            return size
        batches = max(batches + 1, math.ceil(batches * needed / max(free, 1)))
