"""Add runs that only tried something to a file of results/TASK/tried.

python scripts/record_tried.py OUT RUN [RUN ...] --changed "no imitation"

OUT is a list with one entry per run: the change, the record of the run, and its evaluations so
far. Runs may have been stopped early. A run that is recorded again replaces its entry.
"""

import argparse
import json
from pathlib import Path

from hmasd_jax.runs.folder import write_json
from scripts.run_records import record


def add(out: Path, runs: list[Path], changed: str) -> list[dict]:
    """Write the entries of `runs` to `out`, behind those of other runs, and return all."""
    entries = json.loads(out.read_text()) if out.exists() else []
    for run in runs:
        new = {"changed": changed, **record(run)}
        entries = [entry for entry in entries if _run_of(entry) != _run_of(new)] + [new]
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out, entries)
    return entries


def _run_of(entry: dict) -> tuple[str, str | None]:
    """Return what tells the run of an entry from others. A resumed run keeps both."""
    return entry["command"], entry.get("started")


def main() -> None:
    """Record the runs of the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="JSON file of results/TASK/tried")
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="folder of a run")
    parser.add_argument("--changed", required=True, help="what differs from the preset")
    args = parser.parse_args()
    try:
        add(args.out, args.runs, args.changed)
    except ValueError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
