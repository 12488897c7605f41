"""Record a finished run in results/TASK/NAME.json, draw it, and rewrite the tables of results.

python scripts/record_result.py RUN [RUN ...] results/alice_and_bob/hmasd.json
python scripts/record_result.py --add RUN [RUN ...] results/alice_and_bob/hmasd.json
python scripts/record_result.py      # only rewrites the tables from the recorded files

The tables are all of docs/results.md and the paper's comparison in README.md.

TASK is one of `TASKS`. NAME begins with the algorithm's name, or with `no` for an ablation. Several
runs are recorded as one. They have one seed each, from the same command but for its `--seed-index`.
With `--add` they go behind the seeds that are recorded.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from hmasd_jax.analysis.curves import plot_result
from hmasd_jax.analysis.learning import LAST
from hmasd_jax.analysis.statistics import estimate_iqm
from hmasd_jax.runs import durable
from scripts import comparison
from scripts.paper import TASKS, Task, final_scores, summarize_record
from scripts.records import RESULTS, ROOT, fill_place
from scripts.result_figures import SKILLS, TOGETHER, draw_together
from scripts.result_settings import changed_settings, pays_otherwise, preset_of
from scripts.run_records import (
    add_seeds,
    commits_of,
    cut_seeds,
    of_each_seed,
    record_together,
    stopped,
)

PAGE = ROOT / "docs" / "results.md"
README = ROOT / "README.md"


HEAD = """# Results

`python scripts/record_result.py` writes this page from the files in [`results/`](../results). Each
file holds the command, configuration, commit, versions and hardware of a run, and every evaluation
of every seed. All but the oldest also hold the training metrics, as means over each tenth of the
run. A score is the success rate of greedy episodes in percent, or their mean return. It is averaged
over the last {last} evaluations of each seed, then over seeds. "±" is the (population) standard
deviation over seeds, as in the paper (five seeds). "IQM" is the interquartile mean over seeds,
without the lowest and the highest quarter. Brackets are 95 % bootstrap intervals, and "worst" is
the worst seed. "Minutes" are the wall-clock time of training and evaluation, without compilation,
summed over the seeds, or of all seeds at once on a GPU.

"Stopped" seeds had no reward until they ended early, after half of their steps or more, and score
0. It is no good rule: of some 110 seeds with the paper's presets that had no reward in the first
half, three learned later. Where others ended early, the table gives their steps beside those of the
preset.

A row is named after its file. Names begin with the algorithm, or with `no` for an ablation:

| name ends in | meaning |
|---|---|
| `_general` | our preset with the same settings of the algorithm in all tasks |
| `_general_before` | its first form (f980c2a): nothing changes once a task is solved |
| `_general_clipped` | the next form (6d33107): gradients clipped at a norm of 0.5, steps of full \
length, and skills that are paid more as earnings grow, in Overcooked, too |
| `_general_coordinator` | the next form (dee9840): only the coordinator's steps shorten on solved \
tasks |
| `_general_both_levels` | an alternative to the next (19ab0f7): the discoverer's steps shorten \
like the coordinator's |
| `_general_unsharpened` | the next form (04fcaec): actions are not sharpened, and the frontier \
pays the step of a success, and counts an episode several times in a bin that was made of several |
| `_general_unmixed` | the next form (c04a7af): on solved tasks no skills are drawn at random, q_d \
is not balanced, actions gain no entropy, and the gain is 3 |
| `_general_per_value` | the next form (e07735e): the bonus pays a step for every value that it \
passes |
| `_general_small_odds` | the next form (212fbf7): in Overcooked the bonus makes much of small \
odds. Elsewhere it is the form `_general_whole` |
| `_general_by_agent` | the next form (b58b511): in Overcooked the state names cooks by agent and \
not by seat. Elsewhere it is the next |
| `_general_whole` | the next form (9e46234): the bonus counts each episode once, however long, \
and does not fade. For tasks with episodes of at most 200 steps it is the next |
| `_general_rarest` | the form before today's (6f122d0): the bonus pays a feature for the rarest \
of the values that it passes in a step, and not for the others |
| `_robust` | a retired preset of ours with prior knowledge of the task |
| `_again` | the preset of the row without it once more, at a later commit |
| `_first` | earlier seeds of the row without it |
| `_fresh` | the preset of the row without it, with seeds on which it was not tuned |
| `_cpu` | the preset of the row without it at an earlier commit and on a CPU |
| `_disc` | the preset of the row without it, since units start in a disc (commit cf92a6c) |
| `_lambda_095` | the retired preset with a lambda of GAE of 0.95 |
| `_skill_interval_K`, `_num_team_skills_N`, `_num_skills_N` | other skills (the paper's Fig. 10) |
| `_terminal` | an earlier form of the retired preset, for which the time limit ends the task |

To repeat a row, check out its commit and run its command. A loop over `--seed-index` trains the
same seeds as `seed_sweep` with the other options of the loop.

A row marked * has other settings than today's form of the preset that its command names: the preset
has changed since, or the command changes it. A table below names these settings. A row marked † was
recorded before b7c915c, the last change of what the exploration bonus pays for.

## The paper's comparison

Ours above, the paper's below. `python scripts/comparison.py` counts the seeds that are wanted and
recorded, and with `--commands` prints what is left to run. A number marked * has other settings
than today's preset. A seed has learned if it scores at least a tenth of the best of its
cell, and at least 5 %.
"""
COLUMNS = (
    "| configuration | seeds | env steps | paper | ours | IQM | worst | seeds ≥ {bar} | commit "
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
    final = summarize_record(kept, task)
    low, high = final["interval"]
    iqm = estimate_iqm(final_scores(kept))
    mark = (" †" if pays_otherwise(kept) else "") + (" *" if changed_settings(kept) else "")
    steps = f"{kept['env_steps'][-1]:,}"
    if cut_seeds(kept):
        steps += f" of {kept['config']['total_env_steps']:,}"
    cells = [
        f"[{path.stem}](../{path.relative_to(ROOT)}){mark}",
        f"{final['seeds']}{stopped(kept)}",
        steps,
        task.paper.get(path.stem) or task.paper.get(algorithm_of(path), ""),
        f"{final['mean']:.1f} ± {final['std']:.1f} [{low:.1f}, {high:.1f}]",
        f"{iqm.value:.1f} [{iqm.low:.1f}, {iqm.high:.1f}]",
        f"{final['min']:.1f}",
        f"{final['fraction_solved']:.0%}",
        ", ".join(f"`{commit[:7]}`" for commit in commits_of(kept)),
        minutes(kept),
    ]
    return f"| {' | '.join(cells)} |"


def minutes(kept: dict[str, Any]) -> str:
    """Format the time of training, in which the seeds on a GPU train all at once."""
    cpu, gpu = [], []
    for device, seconds in zip(of_each_seed(kept, "device"), kept["wall_seconds"]):
        (gpu if device.startswith("gpu") else cpu).append(seconds)
    times = [f"{sum(cpu) / 60:.0f}"] if cpu else []
    return " + ".join([*times, f"{max(gpu) / 60:.0f} (GPU)"] if gpu else times)


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
        for line in (f"    # {', '.join(names)}", f"    {shell(command)}")
    ]


def shell(command: str) -> str:
    """Return a command of several seeds, as in records, as a loop of a shell."""
    each, several, seeds = command.partition(" --seed-index I for I = ")
    if not several:
        return command
    return f"for I in {seeds.replace(',', ' ')}; do {each} --seed-index $I; done"


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
    return "\n".join([HEAD.format(last=LAST), *comparison.table(), "", *sections])


def readme() -> str:
    """Return the text of README.md, with the table of the comparison as recorded."""
    return fill_place(README.read_text(), "comparison", "\n".join(comparison.table()))


def keep(runs: list[Path], out: Path, add: bool = False) -> None:
    """Write the record of `runs` to `out` and draw the images of its task.

    Args:
        runs: folders of the runs.
        out: file to write.
        add: if True, keep the seeds that `out` may have, and put those of `runs` behind them.

    Raises:
        ValueError: `out` is not a JSON file in the folder of a task in `TASKS`, or a run is not
            finished, differs from the others or has too few evaluations.
    """
    folders = {RESULTS / name: name for name in TASKS}
    if out.parent not in folders or out.suffix != ".json":
        raise ValueError(f"OUT must be results/TASK/NAME.json with TASK one of {', '.join(TASKS)}")
    task = folders[out.parent]
    is_more = add and out.exists()
    kept = add_seeds(json.loads(out.read_text()), runs) if is_more else record_together(runs)
    final_scores(kept)  # Raises an error where the page could not be written.
    out.parent.mkdir(parents=True, exist_ok=True)
    durable.replace(out, f"{json.dumps(kept)}\n".encode())
    if algorithm_of(out) == "hmasd" and not any(setting in out.stem for setting in SKILLS):
        plot_result(out, out.with_suffix(".png"), TASKS[task].reference)
    draw_together(task, recorded(task))


def main() -> None:
    """Record runs if some are given, then rewrite the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "paths",
        type=Path,
        nargs="*",
        metavar="PATH",
        help="folders of finished runs, then the file to write: results/TASK/NAME.json",
    )
    parser.add_argument("--add", action="store_true", help="keep the seeds that OUT has already")
    args = parser.parse_args()
    paths = args.paths
    if len(paths) == 1:
        parser.error("give OUT too, the file to write: results/TASK/NAME.json")
    if paths:
        *runs, out = paths
        try:
            keep(runs, out.resolve(), args.add)
        except ValueError as error:
            parser.error(str(error))
    PAGE.write_text(page())
    README.write_text(readme())


if __name__ == "__main__":
    main()
