"""Record a finished run in results/TASK/NAME.json, draw it, and rewrite docs/results.md.

python scripts/record_result.py RUN [RUN ...] results/alice_and_bob/hmasd.json
python scripts/record_result.py      # only rewrites docs/results.md from the recorded files

TASK is one of `TASKS`. NAME begins with the algorithm's name, or with `no` for an ablation. Several
runs are recorded as one. They have one seed each, from the same command but for its `--seed-index`.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

from hmasd_jax.analysis.curves import Reference, plot_result
from hmasd_jax.analysis.learning import LAST
from hmasd_jax.analysis.statistics import last_evaluations, summarize
from scripts.records import RESULTS, ROOT
from scripts.result_figures import TOGETHER, draw_together
from scripts.result_settings import changed_settings, preset_of
from scripts.run_records import record_together

PAGE = ROOT / "docs" / "results.md"


class Task(NamedTuple):
    """Task of the paper, in the units of the page: percent of success, or the return."""

    paper: dict[str, str]
    """Mean and standard deviation over the paper's five seeds, by algorithm."""
    bar: float
    """Score from which a seed counts as one that learned."""
    reference: Reference | None = None
    """Curve of the paper's HMASD, read off its figures; final numbers are the text's if given."""


TASKS = {
    "alice_and_bob": Task(
        {"hmasd": "74 ± 26", "mappo": "0", "mat": "40 ± 49", "maser": "0"},
        90,
        Reference(
            "paper, Fig. 5 (5 seeds)",
            (0.5e6, 1.0e6, 1.3e6, 1.9e6, 2.5e6),
            (0.21, 0.60, 0.64, 0.55, 0.79),
            final=(0.74, 0.26),
        ),
    ),
    "overcooked/cramped_room": Task(
        {
            "hmasd": "236 ± 8",
            "mappo": "180 ± 90",
            "mat": "168 ± 88",
            "maser": "0",
            "eiti": "0.122 ± 0.013",
            "edti": "0.119 ± 0.015",
        },
        200,  # below the worst of the paper's five, 220 if four have 240
        Reference("paper, Fig. 7 (5 seeds)", (3e6, 4.5e6), (94, 213), final=(236, 8)),
    ),
    "overcooked/asymmetric_advantages": Task(
        {
            "hmasd": "295 ± 85",
            "mappo": "52 ± 104",
            "mat": "86 ± 112",
            "maser": "0",
            "eiti": "0.008 ± 0.002",
            "edti": "0.004 ± 0.002",
        },
        295,
    ),
    "overcooked/coordination_ring": Task(
        {"hmasd": "80 ± 98", "mappo": "0", "mat": "0", "maser": "0", "eiti": "0", "edti": "0"}, 80
    ),
    "micro_battle/3m": Task(
        {"hmasd": "80 ± 40", "mappo": "0", "mat": "0", "maser": "62"},
        80,
        Reference(
            "paper, Fig. 6 (5 seeds, StarCraft II)",
            (0.7e6, 1.0e6, 1.2e6),
            (0.08, 0.49, 0.72),
            final=(0.8, 0.4),
        ),
    ),
    "micro_battle/2s_vs_1sc": Task(
        {"hmasd": "60 ± 49", "mappo": "0", "mat": "0", "maser": "0"}, 80
    ),
    "micro_battle/2m_vs_1z": Task({"hmasd": "40 ± 49", "mappo": "0", "mat": "0", "maser": "0"}, 80),
}

HEAD = """# Results

`python scripts/record_result.py` writes this page from the files in [`results/`](../results). Each
file holds the command, configuration, commit, versions and hardware of a run, and every evaluation
of every seed. All but the oldest also hold the training metrics, as means over each tenth of the
run. A score is the success rate of greedy episodes in percent, or their mean return. It is averaged
over the last {last} evaluations of each seed, then over seeds. "±" is the (population) standard
deviation over seeds, as in the paper (five seeds). Brackets are the 95 % bootstrap interval of the
mean, and "worst" is the worst seed. "Minutes" are the wall-clock time of training and evaluation,
without compilation, summed over the seeds.

A row is named after its file. Names begin with the algorithm, or with `no` for an ablation:

| name ends in | meaning |
|---|---|
| `_general` | our preset with the same settings of the algorithm in all tasks |
| `_robust` | a retired preset of ours with prior knowledge of the task |
| `_again` | the same command as the row without it, at a later commit |
| `_fresh` | the preset of the row without it, with seeds on which it was not tuned |
| `_disc` | the preset of the row without it, since units start in a disc (commit cf92a6c) |
| `_lambda_095` | the retired preset with a lambda of GAE of 0.95 |
| `_terminal` | an earlier form of the retired preset, for which the time limit ends the task |

A row marked * has other settings than today's form of the preset that its command names: the preset
has changed since, or the command changes it. A table below names these settings.
"""
COLUMNS = (
    "| configuration | seeds | env steps | paper | ours | worst | seeds ≥ {bar} | commit "
    "| minutes |"
)
DIFFERENCES = """| row | setting | recorded | today's preset |
|---|---|---|---|"""


def recorded(task: str) -> list[Path]:
    """Return the recorded files of a task, sorted by name."""
    return sorted((RESULTS / task).glob("*.json"))


def algorithm_of(path: Path) -> str:
    """Return the algorithm that a file name begins with, `hmasd` for `hmasd_robust.json`."""
    return path.stem.partition("_")[0]


def row(path: Path, kept: dict[str, Any], task: Task) -> str:
    """Format the line of the table for a run `kept` in the file `path`."""
    scale = 100 if kept["metric"] == "success" else 1
    final = summarize(scale * last_evaluations(kept["values"], LAST), solved_at=task.bar)
    low, high = final["interval"]
    mark = " *" if changed_settings(kept) else ""
    cells = [
        f"[{path.stem}](../{path.relative_to(ROOT)}){mark}",
        str(final["seeds"]),
        f"{kept['env_steps'][-1]:,}",
        task.paper.get(algorithm_of(path), ""),
        f"{final['mean']:.1f} ± {final['std']:.1f} [{low:.1f}, {high:.1f}]",
        f"{final['min']:.1f}",
        f"{final['fraction_solved']:.0%}",
        f"`{kept['commit'][:7]}`",
        f"{sum(kept['wall_seconds']) / 60:.0f}",
    ]
    return f"| {' | '.join(cells)} |"


def differences(files: list[Path], kept: list[dict[str, Any]]) -> list[str]:
    """Return the lines of the table of settings that are not those of today's presets."""
    rows = []
    for path, result in zip(files, kept):
        preset = preset_of(result)
        for name, values in changed_settings(result).items():
            was, now = (f"`{json.dumps(value)}`" for value in values)
            rows.append(f"| {path.stem} | `{name}` | {was} | {now} in `{preset.name}` |")
    return ["", DIFFERENCES, *rows] if rows else []


def commands(files: list[Path], kept: list[dict[str, Any]]) -> list[str]:
    """Return each command below the names of its rows, as an indented block."""
    rows: dict[str, list[str]] = {}
    for path, result in zip(files, kept):
        rows.setdefault(result["command"], []).append(path.stem)
    return [
        line
        for command, names in rows.items()
        for line in (f"    # {', '.join(names)}", f"    {command}")
    ]


def section(name: str, task: Task) -> str:
    """Return the part of the page on a task that has records."""
    files = recorded(name)
    kept = [json.loads(path.read_text()) for path in files]
    columns = COLUMNS.format(bar=f"{task.bar:g}")
    table = [
        columns,
        "|---" * COLUMNS.count(" | ") + "|---|",
        *(row(path, result, task) for path, result in zip(files, kept)),
        *differences(files, kept),
    ]
    images = [
        f"![{image.stem}](../{image.relative_to(ROOT)})"
        for image in sorted((RESULTS / name).glob("*.png"))
        if image.stem in TOGETHER or image.with_suffix(".json") in files
    ]
    return "\n".join([f"## {name}\n", *table, "", *commands(files, kept), "", *images, ""])


def page() -> str:
    """Return the text of docs/results.md."""
    sections = [section(name, task) for name, task in TASKS.items() if recorded(name)]
    return "\n".join([HEAD.format(last=LAST), *sections])


def keep(runs: list[Path], out: Path) -> None:
    """Write the record of `runs` to `out` and draw the images of its task.

    Raises:
        ValueError: `out` is not a JSON file in the folder of a task in `TASKS`, or a run is not
            finished, or differs from the others.
    """
    folders = {RESULTS / name: name for name in TASKS}
    if out.parent not in folders or out.suffix != ".json":
        raise ValueError(f"OUT must be results/TASK/NAME.json with TASK one of {', '.join(TASKS)}")
    task = folders[out.parent]
    kept = record_together(runs)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(kept) + "\n")
    if algorithm_of(out) == "hmasd":
        plot_result(out, out.with_suffix(".png"), TASKS[task].reference)
    draw_together(task, recorded(task))


def main() -> None:
    """Record runs if some are given, then rewrite the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "paths",
        type=Path,
        nargs="*",
        metavar="PATH",
        help="folders of finished runs, then the file to write: results/TASK/NAME.json",
    )
    paths = parser.parse_args().paths
    if len(paths) == 1:
        parser.error("give OUT too, the file to write: results/TASK/NAME.json")
    if paths:
        *runs, out = paths
        try:
            keep(runs, out.resolve())
        except ValueError as error:
            parser.error(str(error))
    PAGE.write_text(page())


if __name__ == "__main__":
    main()
