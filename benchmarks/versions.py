"""Compare one update of training at several commits of this repository, in turn on one core.

python benchmarks/versions.py COMMIT... [--algorithm hmasd mappo mat] [--env alice_and_bob] [--json]

COMMIT `.` is this checkout as it stands, e.g. `versions.py 5faca0e . --algorithm hmasd mappo mat`.
Each commit's package runs at the paper's settings in a process of its own. All processes are asked
in turn, in the opposite order every other round. `ratio` is the work per CPU-second relative to the
first commit: the median over rounds, and its 95 % bootstrap interval.
"""

import io
import json
import os
import statistics
import subprocess
import sys
import tarfile
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import ON_POLICY, Row, parser, report
from benchmarks.training import preset
from envs_jax.registry import ENVIRONMENTS
from hmasd_jax.analysis.statistics import estimate
from hmasd_jax.config import TrainConfig
from hmasd_jax.runs import folder as run_folder
from hmasd_jax.training.workers import pin

ROOT = Path(__file__).parents[1]
CHECKOUT = "."
ROUNDS_PER_REPEAT = 5
"""Updates take about a second, so there is time for more of them than of most measurements."""


class Version:
    """Process that trains updates with the package of one commit."""

    def __init__(self, commit: str, package: Path, settings: dict[str, Any]) -> None:
        """Start the process and compile.

        Args:
            commit: a commit of this repository, or `.` for this checkout.
            package: folder that holds the commit's `src` and `envs_jax`.
            settings: values by dotted name.
        """
        head = _git("log", "-1", "--format=%h %s", "HEAD" if commit == CHECKOUT else commit)
        name = head.decode().strip()
        self.name = f"this checkout, on {name}" if commit == CHECKOUT else name
        self.process = subprocess.Popen(
            [sys.executable, ROOT / "benchmarks" / "serve_update.py", json.dumps(settings)],
            env=os.environ | {"PYTHONPATH": f"{package / 'src'}:{package}", "JAX_PLATFORMS": "cpu"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.compile_s = self._answer()
        self.update()  # the first one does not count
        self.seconds: list[float] = []

    def update(self) -> float:
        """Train one update and return its CPU-seconds."""
        assert self.process.stdin
        print(file=self.process.stdin, flush=True)
        return self._answer()

    def _answer(self) -> float:
        assert self.process.stdout
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self.name} cannot train an update: see its error message above")
        return float(line)

    def row(self, first: "Version", config: TrainConfig, **about: Any) -> Row:
        """Return the row of this version, with its ratio to the `first`."""
        median = statistics.median(self.seconds)
        ratios = np.array(first.seconds) / np.array(self.seconds)
        ratio = estimate([ratios], lambda groups: np.median(groups[0]))
        return Row(
            self.name,
            seeds=1,
            env_steps_per_cpu_s=config.env_steps_per_update / median,
            compile_s=self.compile_s,
            spread=(max(self.seconds) - min(self.seconds)) / median,
            ratio=ratio.value,
            ratio_interval=None if self is first else (ratio.low, ratio.high),
            **about,
        )


def unpack(commit: str, folder: Path) -> Path:
    """Return a folder that holds the packages of `commit`: `folder`, or the root for `.`."""
    if commit == CHECKOUT:
        return ROOT
    packages = io.BytesIO(_git("archive", commit, "src", "envs_jax"))
    with tarfile.open(fileobj=packages) as archive:
        archive.extractall(folder, filter="data")
    return folder


def bench(packages: dict[str, Path], env: str, algorithm: str, quick: bool, rounds: int) -> list:
    """Return a row per commit, `packages` holding the folder of each."""
    settings, config = preset(env, algorithm, quick)
    with ExitStack() as stack:
        versions = []
        for commit, package in packages.items():
            versions.append(Version(commit, package, settings))
            stack.enter_context(versions[-1].process)
        for number in range(rounds):
            for version in versions if number % 2 else reversed(versions):
                version.seconds.append(version.update())
    return [version.row(versions[0], config, env=env, algorithm=algorithm) for version in versions]


def _git(*words: str) -> bytes:
    return subprocess.run(["git", *words], cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout


def main() -> None:
    """Run the benchmark from the command line."""
    options = parser(__doc__)
    options.add_argument("commits", nargs="+", metavar="COMMIT", help="the first is the reference")
    options.add_argument("--env", default="alice_and_bob", choices=ENVIRONMENTS)
    options.add_argument("--algorithm", nargs="+", default=["hmasd"], choices=ON_POLICY)
    args = options.parse_args()
    pin(run_folder.available_cores()[0])
    rounds = args.repeats * (1 if args.quick else ROUNDS_PER_REPEAT)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        packages = {
            commit: unpack(commit, Path(folder) / str(number))
            for number, commit in enumerate(args.commits)
        }
        for algorithm in args.algorithm:
            rows += bench(packages, args.env, algorithm, args.quick, rounds)
    report(rows, args.json)


if __name__ == "__main__":
    main()
