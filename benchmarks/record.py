"""Run benchmarks, keep what they print, and write their tables into docs/performance.md.

python benchmarks/record.py NAME...          # run these (of BENCHMARKS), then write the tables
python benchmarks/record.py                  # only write the tables, from the files that are there

A table stands between `<!-- NAME -->` and `<!-- end -->`; the text around it is written by hand.
"""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks.measure import ABOUT, text
from hmasd_jax.runs import folder as run_folder

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "performance.md"
KEPT = ROOT / "results" / "benchmarks"
BENCHMARKS = {
    "environments": "benchmarks/environments.py",
    "training": "benchmarks/training.py",
    "versions": "benchmarks/versions.py e5f0d7b f443450 223bcfc 3effb21 2856573 7dc47dd 65773a2"
    " 57e879c",
    "seeds": "benchmarks/seeds.py",
    "compare": "benchmarks/compare.py --jaxmarl JaxMARL",
    "growth": "benchmarks/growth.py --repeats 3 --out results/benchmarks/growth.png",
}


def run(name: str, about: dict[str, Any]) -> None:
    """Run one benchmark; its rows go to results/benchmarks/NAME.json, with what it is run on.

    Raises:
        SystemExit: it failed.
    """
    command = [*BENCHMARKS[name].split(), "--json"]
    done = subprocess.run([sys.executable, *command], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise SystemExit(f"{name} failed")
    kept = {
        "command": f"python {BENCHMARKS[name]}",
        **{key: about[key] for key in ABOUT},
        "started": about["started"],
        "rows": [json.loads(line) for line in done.stdout.splitlines()],
    }
    KEPT.mkdir(parents=True, exist_ok=True)
    run_folder.write_json(KEPT / f"{name}.json", kept)


def table(kept: dict[str, Any]) -> str:
    """The rows of one benchmark as Markdown, under what was run where."""
    rows = kept["rows"]
    columns = [key for key in rows[0] if any(row[key] is not None for row in rows)]
    head = [column.replace("_", " ") for column in columns]
    lines = [head, ["---"] * len(head), *([text(row[c]) for c in columns] for row in rows)]
    about = ", ".join(f"{key} {kept[key]}" for key in ABOUT)
    return "\n".join([f"`{kept['command']}`  ", f"{about}", "", *map(_line, lines)])


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def write_page() -> None:
    """Replace the tables in docs/performance.md by what was kept."""
    page = PAGE.read_text()
    for path in sorted(KEPT.glob("*.json")):
        new = f"<!-- {path.stem} -->\n{table(json.loads(path.read_text()))}\n<!-- end -->"
        pattern = rf"<!-- {path.stem} -->.*?<!-- end -->"
        if not re.search(pattern, page, re.DOTALL):
            raise SystemExit(f"{PAGE} has no place for {path.stem}: add <!-- {path.stem} -->")
        page = re.sub(pattern, lambda _, new=new: new, page, flags=re.DOTALL)
    PAGE.write_text(page)


def main(names: list[str]) -> None:
    """Run the named benchmarks, then write the page.

    Raises:
        SystemExit: there is none of that name, or one failed.
    """
    for name in names:
        if name not in BENCHMARKS:
            raise SystemExit(f"unknown benchmark {name!r} (known: {', '.join(BENCHMARKS)})")
    # Once, and first: what is written afterwards makes the checkout differ from its commit.
    about = run_folder.describe([]) if names else {}
    for name in names:
        run(name, about)
    write_page()


if __name__ == "__main__":
    main(sys.argv[1:])
