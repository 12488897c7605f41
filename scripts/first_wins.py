"""Record when seeds first store a success, and when they first win a tenth of their episodes.

python scripts/first_wins.py OUT RUN [RUN ...]

OUT (JSON) gets one row per seed: the command and commit of its run, and the environment steps until
each happened in training, or null if it never did.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hmasd_jax.runs import metrics_log
from hmasd_jax.runs.folder import metrics_path, seeds_of
from scripts.records import describe_script, write_rows

TENTH = 0.1


def measure(run: Path) -> Iterator[dict[str, Any]]:
    """Yield a row per seed of a run."""
    about = json.loads((run / "run.json").read_text())
    for seed in seeds_of(run):
        records = [r for r in metrics_log.read(metrics_path(run, seed)) if r["kind"] == "train"]
        yield {
            "command": " ".join(about["command"]),
            "commit": about["commit"],
            "seed": seed,
            "first success": first(records, "exploration/stored_successes", 0.0),
            "a tenth": first(records, "success", TENTH),
            "trained": records[-1]["env_steps"],
        }


def first(records: list[dict[str, Any]], metric: str, level: float) -> int | None:
    """Return the environment steps of the first record with a metric above `level`."""
    return next((r["env_steps"] for r in records if r.get(metric, 0.0) > level), None)


def main() -> None:
    """Record the runs of the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT", help="JSON file to write")
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="folder of a run")
    args = parser.parse_args()
    about = describe_script()
    write_rows(args.out, about, [row for run in args.runs for row in measure(run)])


if __name__ == "__main__":
    main()
