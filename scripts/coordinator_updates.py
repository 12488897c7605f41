"""Record how far each update moves the coordinator of runs, beside the success in training.

python scripts/coordinator_updates.py OUT RUN [RUN ...]

OUT (JSON) gets one entry per run of one seed: what produced it, and of each training record after
0.6e6 environment steps the success of all copies, the KL divergence of an update of the
coordinator, and the entropy of an individual skill. A record is a mean over updates.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from hmasd_jax.runs import folder as run_folder
from hmasd_jax.runs import metrics_log

FIRST_STEP = 600_000
"""Environment steps before which records are left out: the task is not solved yet."""
METRICS = {
    "success": "success",
    "coordinator/approx_kl": "coordinator_kl",
    "coordinator/skill_entropy": "skill_entropy",
}
"""Training metrics that are kept, and what a record calls them."""


def measure(run: Path) -> dict[str, Any]:
    """Return the entry of a run.

    Raises:
        ValueError: the run has not exactly one seed, or none of its records has all metrics.
    """
    seeds = run_folder.seeds_of(run)
    if len(seeds) != 1:
        raise ValueError(f"RUN must hold one seed, but {run} holds {len(seeds)}")
    records = [
        record
        for record in metrics_log.read(run_folder.metrics_path(run, seeds[0]))
        if record["env_steps"] > FIRST_STEP and METRICS.keys() <= record.keys()
    ]
    if not records:
        raise ValueError(f"{run} has no record of {', '.join(METRICS)} after {FIRST_STEP} steps")
    about = json.loads((run / "run.json").read_text())
    columns = {
        short: [float(f"{record[name]:.4g}") for record in records]
        for name, short in METRICS.items()
    }
    return {**about, "env_steps": [record["env_steps"] for record in records], **columns}


def main() -> None:
    """Record the runs of the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT", help="JSON file to write")
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="folder of an HMASD run")
    args = parser.parse_args()
    try:
        entries = [measure(run) for run in args.runs]
    except ValueError as error:
        parser.error(str(error))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    run_folder.write_json(args.out, entries)


if __name__ == "__main__":
    main()
