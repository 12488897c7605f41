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

from hmasd_jax.analysis.curves import read_curves
from hmasd_jax.analysis.figures import Curve
from hmasd_jax.runs.folder import RunError
from scripts.records import describe_script, write_rows

METRICS = ("exploration/stored_successes", "success", "team_reward")
TENTH = 0.1


def measure(run: Path) -> Iterator[dict[str, Any]]:
    """Yield a row per seed of a run."""
    stored, won, trained = (read_curves(run, "train", metric) for metric in METRICS)
    about = json.loads((run / "run.json").read_text())
    for seed in trained:
        yield {
            "command": " ".join(about["command"]),
            "commit": about["commit"],
            "seed": seed,
            "first success": first_above(stored.get(seed), 0.0),
            "a tenth": first_above(won.get(seed), TENTH),
            "trained": int(trained[seed][0][-1]),
        }


def first_above(curve: Curve | None, level: float) -> int | None:
    """Return the environment steps of the first value above `level`, None without any."""
    if curve is None:
        return None
    env_steps, values = curve
    above = env_steps[values > level]
    return int(above[0]) if len(above) else None


def main() -> None:
    """Record the runs of the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT", help="JSON file to write")
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="folder of a run")
    args = parser.parse_args()
    about = describe_script()
    try:
        rows = [row for run in args.runs for row in measure(run)]
    except RunError as error:
        parser.error(str(error))
    write_rows(args.out, about, rows)


if __name__ == "__main__":
    main()
