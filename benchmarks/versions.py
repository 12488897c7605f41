"""One update of HMASD as it was at several commits of this repository, in turn on one core.

python benchmarks/versions.py COMMIT... [--json]

The paper's settings. Each commit's package runs in a process of its own, all are asked in turn.
"""

import io
import os
import statistics
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

from benchmarks.measure import Row, parser, report
from hmasd_jax.hmasd import HMASDConfig
from hmasd_jax.runs import folder as run_folder
from hmasd_jax.training import workers as sweep

ROOT = Path(__file__).parents[1]


class Version:
    """A process that trains updates with the package of one commit."""

    def __init__(self, commit: str, env: str, folder: Path) -> None:
        self.name = _git("log", "-1", "--format=%h %s", commit).decode().strip()
        packages = io.BytesIO(_git("archive", commit, "src", "envs_jax"))
        with tarfile.open(fileobj=packages) as archive:
            archive.extractall(folder, filter="data")
        self.process = subprocess.Popen(
            [sys.executable, ROOT / "benchmarks" / "serve_update.py", env],
            env=os.environ | {"PYTHONPATH": f"{folder / 'src'}:{folder}"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.compile_s = self.answer()
        self.update()  # the first one does not count
        self.seconds: list[float] = []

    def update(self) -> float:
        """CPU-seconds of one update."""
        assert self.process.stdin
        print(file=self.process.stdin, flush=True)
        return self.answer()

    def answer(self) -> float:
        """The next line the process writes.

        Raises:
            RuntimeError: it failed; it has told why.
        """
        assert self.process.stdout
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self.name}: no update could be trained")
        return float(line)

    def row(self, env: str) -> Row:
        """What was measured."""
        ppo, median = HMASDConfig().ppo, statistics.median(self.seconds)
        return Row(
            self.name,
            env=env,
            algorithm="hmasd",
            seeds=1,
            env_steps_per_cpu_s=ppo.num_envs * ppo.rollout_length / median,
            compile_s=self.compile_s,
            spread=(max(self.seconds) - min(self.seconds)) / median,
        )


def _git(*words: str) -> bytes:
    return subprocess.run(["git", *words], cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout


def main() -> None:
    """Run the benchmark from the command line."""
    options = parser(__doc__)
    options.add_argument("commits", nargs="+", help="oldest first")
    args = options.parse_args()
    sweep.pin(run_folder.available_cores()[0])
    with tempfile.TemporaryDirectory() as folder:
        versions = [
            Version(commit, args.env, Path(folder) / str(number))
            for number, commit in enumerate(args.commits)
        ]
        for _ in range(1 if args.quick else 5 * args.repeats):
            for version in versions:
                version.seconds.append(version.update())
        for version in versions:
            version.process.communicate()
    report([version.row(args.env) for version in versions], args.json)


if __name__ == "__main__":
    main()
