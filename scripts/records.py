"""JSON records of what the scripts measure, together with what produced them."""

import json
import sys
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


def write_rows(out: Path, about: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    """Write measured `rows` to the JSON file `out`, below what produced them."""
    out.parent.mkdir(parents=True, exist_ok=True)
    run_folder.write_json(out, about | {"rows": rows})
