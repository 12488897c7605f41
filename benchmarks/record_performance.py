"""Run benchmarks, record their rows, and write their tables into docs/performance.md.

python benchmarks/record_performance.py NAME...    # runs these of `BENCHMARKS`, then writes tables
python benchmarks/record_performance.py            # only writes the tables, from recorded rows

A table stands between `<!-- NAME -->` and `<!-- end -->`. The text around it is written by hand.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks.measure import ABOUT, text
from hmasd_jax.config import RENAMED
from hmasd_jax.runs import folder as run_folder
from scripts.records import fill_place

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "performance.md"
RECORDS = ROOT / "results" / "benchmarks"
BENCHMARKS = {
    "time_to_solve": "benchmarks/time_to_solve.py",
    "environments": "benchmarks/environments.py",
    "training": "benchmarks/training.py",
    "versions": "benchmarks/versions.py e5f0d7b f443450 223bcfc 3effb21 2856573 7dc47dd 65773a2"
    " 57e879c",
    "versions_mat": "benchmarks/versions.py 88900ff 2efd8d6 --algorithm mat",
    "seeds": "benchmarks/seeds.py",
    "compare": "benchmarks/compare.py --jaxmarl JaxMARL",
    "maser": "benchmarks/maser.py --python TORCH/bin/python --checkout MASER"
    " --scenario 3m 2m_vs_1z",
    "growth": "benchmarks/growth.py --repeats 3 --out results/benchmarks/growth.png",
}


def run(name: str, about: dict[str, Any]) -> None:
    """Run one benchmark and record its rows in results/benchmarks/NAME.json.

    Args:
        name: a key of `BENCHMARKS`.
        about: description of the machine and the commit, as `run_folder.describe` returns it.

    Raises:
        SystemExit: the benchmark failed.
    """
    command = [*BENCHMARKS[name].split(), "--json"]
    done = subprocess.run([sys.executable, *command], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise SystemExit(f"benchmark {name} failed: see the error above")
    kept = {
        "command": f"python {BENCHMARKS[name]}",
        **{key: about[key] for key in ABOUT},
        "started": about["started"],
        "rows": [json.loads(line) for line in done.stdout.splitlines()],
    }
    RECORDS.mkdir(parents=True, exist_ok=True)
    run_folder.write_json(RECORDS / f"{name}.json", kept)


def table(kept: dict[str, Any]) -> str:
    """Format the rows of one benchmark as Markdown, below its command and machine.

    Columns have the names of today, also where the record has former ones.
    """
    rows = kept["rows"]
    columns = [key for key in rows[0] if any(row[key] is not None for row in rows)]
    head = [RENAMED.get(column, column).replace("_", " ") for column in columns]
    lines = [head, ["---"] * len(head), *([text(row[c]) for c in columns] for row in rows)]
    about = ", ".join(f"{key} {kept[key]}" for key in ABOUT)
    return "\n".join([f"`{kept['command']}`  ", f"{about}", "", *map(_line, lines)])


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def write_page() -> None:
    """Replace the tables in docs/performance.md by the recorded rows.

    Raises:
        SystemExit: the page has no place for a recorded benchmark.
    """
    page = PAGE.read_text()
    for path in sorted(RECORDS.glob("*.json")):
        try:
            page = fill_place(page, path.stem, table(json.loads(path.read_text())))
        except ValueError as error:
            raise SystemExit(f"{PAGE}: {error}") from error
    PAGE.write_text(page)


def main() -> None:
    """Run the named benchmarks, then write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(BENCHMARKS)}")
    args = parser.parse_args()
    for name in args.names:
        if name not in BENCHMARKS:
            parser.error(f"unknown benchmark {name!r}; choose from {', '.join(BENCHMARKS)}")
    # Described once and first, because the files written below make the checkout dirty.
    about = run_folder.describe([])
    for name in args.names:
        run(name, about)
    write_page()


if __name__ == "__main__":
    main()
