import math
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from hmasd_jax.training import host_memory

FAULTS = """
import resource
import numpy as np
from hmasd_jax.training import host_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(64 * 2**20, np.uint8)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

usual = faults(), faults()
host_memory.keep_freed()
print(*usual, faults(), faults())
"""


@pytest.mark.parametrize(
    ("free", "size"), [(math.inf, 10), (1000, 10), (999, 5), (499, 4), (150, 1), (1, 1)]
)
def test_seeds_are_dealt_into_even_batches_that_fit(free, size, monkeypatch):
    monkeypatch.setattr(host_memory, "available_bytes", lambda: free)
    assert host_memory.seeds_at_once(10, lambda n: 100 * n) == size


def test_workers_are_no_more_than_fit_into_memory(monkeypatch):
    for free, expected in ((math.inf, 8), (5 * host_memory.WORKER_BYTES, 5), (1, 1)):
        monkeypatch.setattr(host_memory, "available_host_bytes", lambda free=free: free)
        assert host_memory.workers_at_once(8) == expected


@pytest.mark.parametrize(
    ("line", "top", "limit", "used", "inactive"),
    [
        ("0::/slurm/job_7", "", "memory.max", "memory.current", "inactive_file"),
        (
            "4:cpuset,memory:/slurm/job_7", "memory",
            "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file",
        ),
    ],
)  # fmt: skip
def test_the_limit_of_a_job_counts_less_what_it_uses(line, top, limit, used, inactive, tmp_path):
    groups, root = tmp_path / "cgroup", tmp_path / "root"
    groups.write_text(f"9:name=systemd:/\n{line}\n")
    assert host_memory.free_bytes_of_groups(groups, root) == math.inf
    job = root / top / "slurm" / "job_7"
    job.mkdir(parents=True)
    for folder, most in ((job, 800), (job.parent, 500)):
        (folder / limit).write_text(f"{most}\n")
        (folder / used).write_text("300\n")
        (folder / "memory.stat").write_text(f"anon 1\n{inactive} 100\n")
    assert host_memory.free_bytes_of_groups(groups, root) == 300
    (job.parent / limit).write_text("max\n" if not top else f"{2**63}\n")
    assert host_memory.free_bytes_of_groups(groups, root) == 600
    (job / used).write_text("2000\n")
    assert host_memory.free_bytes_of_groups(groups, root) == 0


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only GNU's C library can")
def test_freed_memory_is_kept_on_request():
    run = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, check=True)
    *usual, first, again = map(int, run.stdout.split())
    assert min(usual) > 100  # pages come anew each time
    assert first > 100
    assert again < 10


def test_the_predicted_peak_is_what_ps_shows():
    status = Path("/proc/self/status").read_text()
    highest = int(status.partition("VmHWM:")[2].split()[0]) * 1024
    assert host_memory.predicted_peak(0) == pytest.approx(highest, rel=0.02)
    more = 2 * highest
    resident = int(status.partition("VmRSS:")[2].split()[0]) * 1024
    assert host_memory.predicted_peak(more) == pytest.approx(resident + more, rel=0.02)
