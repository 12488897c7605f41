"""JSON records of what the scripts measure, together with what produced them."""

import argparse
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hmasd_jax.runs import folder as run_folder

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results"


def describe_script(run: Path | None = None) -> dict[str, Any]:
    """Describe this process: its command, commit, package versions and hardware.

    Call it before the script writes anything, since a changed file marks the commit with a `+`.

    Args:
        run: folder of the run that the script reads; the record then holds its run.json as `run`.
    """
    script = Path(sys.argv[0]).resolve().relative_to(ROOT)
    about = run_folder.describe(["python", script.as_posix(), *sys.argv[1:]])
    if run is not None:
        about["run"] = json.loads((run / "run.json").read_text())
    return about


def fill_place(text: str, name: str, new: str) -> str:
    """Return `text` with `new` between `<!-- NAME -->` and `<!-- end -->`.

    Raises:
        ValueError: `text` has no such place.
    """
    pattern = rf"<!-- {name} -->.*?<!-- end -->"
    if not re.search(pattern, text, re.DOTALL):
        raise ValueError(f"no place for {name}: add <!-- {name} --> and <!-- end --> to the page")
    filled = f"<!-- {name} -->\n{new}\n<!-- end -->"
    return re.sub(pattern, lambda _: filled, text, count=1, flags=re.DOTALL)


def write_rows(out: Path, about: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    """Write measured `rows` to the JSON file `out`, below what produced them."""
    out.parent.mkdir(parents=True, exist_ok=True)
    run_folder.write_json(out, about | {"rows": rows})


def run_and_out_parser(doc: str | None, run_help: str) -> argparse.ArgumentParser:
    """Return a parser of the arguments RUN and OUT of a script.

    Args:
        doc: docstring of the script, whose first line describes it.
        run_help: kind of run that the script reads.
    """
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument("run", type=Path, metavar="RUN", help=run_help)
    parser.add_argument("out", type=Path, metavar="OUT", help="JSON file to write")
    return parser


def checkpoint_parser(doc: str | None, run_help: str, updates: int) -> argparse.ArgumentParser:
    """Return a parser of RUN, OUT, a checkpoint of RUN and a number of updates after it.

    Args:
        doc: docstring of the script, whose first line describes it.
        run_help: kind of run that the script reads.
        updates: default number of updates.
    """
    parser = run_and_out_parser(doc, run_help)
    parser.add_argument("--seed", type=int, default=0, help="index of the seed in the run")
    parser.add_argument("--step", type=int, required=True, help="step of the checkpoint")
    parser.add_argument("--updates", type=int, default=updates, help="number of updates")
    return parser


def record_seeds(
    doc: str | None, run_help: str, measure: Callable[[Path, int], dict[str, Any]]
) -> None:
    """Read RUN and OUT from the command line, and write one row per seed of the run.

    Args:
        doc: docstring of the script, whose first line describes it.
        run_help: kind of run that the script reads.
        measure: function of the folder of a run and the index of a seed.
    """
    parser = run_and_out_parser(doc, run_help)
    args = parser.parse_args()
    about = describe_script(args.run)
    try:
        rows = [measure(args.run, seed) for seed in run_folder.seeds_of(args.run)]
    except run_folder.RunError as error:
        parser.error(str(error))
    write_rows(args.out, about, rows)
