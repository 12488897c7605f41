"""List the runs of the paper's comparison, and say which of them are recorded.

python scripts/comparison.py             # seeds recorded and wanted, of every cell
python scripts/comparison.py --commands  # a command for each seed that is not recorded

A cell is a system on a task, with the paper's settings and steps: HMASD and the baselines on all
tasks, and on 3m its ablations (Fig. 8) and other skills (Fig. 10). Its record is
results/TASK/NAME.json, to which `scripts/record_result.py --add` adds seeds as they end.
"""

import argparse
import json
from collections.abc import Iterator
from typing import Any, NamedTuple

from benchmarks.time_to_solve import have_learned
from hmasd_jax.analysis.learning import LAST
from hmasd_jax.analysis.statistics import last_evaluations
from scripts.paper import TASKS, summarize_record
from scripts.records import RESULTS
from scripts.result_settings import changed_settings
from scripts.run_records import cut_seeds, recorded_seeds, stopped

SYSTEMS = ("hmasd", "mappo", "mat", "maser", "eiti", "edti")
"""Systems of the table, in its order."""
PAPER_LEARNED = {"hmasd": "26 of 35"}
"""Seeds that learned in the paper, as its appendix counts them."""


class Cell(NamedTuple):
    """A system on a task."""

    task: str
    name: str
    """Name of the record."""
    preset: str
    seeds: int
    """Number of seeds wanted."""
    overrides: dict[str, Any]
    """Settings by dotted name that differ from the preset's."""

    def command(self, seed: int) -> str:
        """Return the command that trains one seed."""
        changed = [f"--{name.replace('_', '-')} {value}" for name, value in self.overrides.items()]
        words = [
            "python -m hmasd_jax.train train",
            f"--config configs/{self.task}/{self.preset}.toml",
            *changed,
            f"--num-seeds {self.seeds} --seed-index {seed}",
            f"--run-dir runs/{self.task.replace('/', '_')}_{self.name}_{seed}",
        ]
        return " ".join(words)

    def missing(self) -> list[int]:
        """Return the seeds that are not recorded to the end with the settings of today."""
        record = find_record(self.task, self.name)
        if record is None or changed_settings(record, self.overrides):
            return list(range(self.seeds))
        cut = cut_seeds(record)
        done = [seed for place, seed in enumerate(recorded_seeds(record)) if place not in cut]
        return [seed for seed in range(self.seeds) if seed not in done]


def find_record(task: str, name: str) -> dict[str, Any] | None:
    """Return a record, or None if there is none."""
    path = RESULTS / task / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else None


def cells() -> Iterator[Cell]:
    """Yield a cell for each number of the paper.

    A number of Fig. 10 is named after the setting that differs from the preset, and its value.
    """
    for task, about in TASKS.items():
        for name in about.paper:
            preset, _, changed = name.partition("_")
            setting, _, value = changed.rpartition("_")
            overrides = {f"algorithm.{setting}": int(value)} if changed else {}
            yield Cell(task, name, preset, seeds_of(task, name), overrides)


def seeds_of(task: str, system: str) -> int:
    """Return the number of seeds wanted: the paper's five, and more on its toy task."""
    if task != "alice_and_bob":
        return 5
    return 30 if system == "hmasd" else 10


def table() -> list[str]:
    """Return the lines of a table of all systems on all tasks, beside the paper's numbers."""
    return [
        f"| task | {' | '.join(system.upper() for system in SYSTEMS)} |",
        "|---" * (1 + len(SYSTEMS)) + "|",
        *(f"| {task} | {' | '.join(shown(task, x) for x in SYSTEMS)} |" for task in TASKS),
        f"| seeds that learned | {' | '.join(map(learned, SYSTEMS))} |",
    ]


def learned(system: str) -> str:
    """Return how many seeds of a system have learned, over all tasks, beside the paper's."""
    count = total = 0
    for task in TASKS:
        if record := find_record(task, system):
            seeds = have_learned(last_evaluations(record["values"], LAST).tolist())
            count += sum(seeds)
            total += len(seeds)
    paper = PAPER_LEARNED.get(system)
    ours = f"{count} of {total}" if total else ""
    return f"{ours}<br>{paper}" if paper else ours


def shown(task: str, system: str) -> str:
    """Return the text of one cell of the table."""
    paper = TASKS[task].paper.get(system)
    if paper is None:
        return ""
    record = find_record(task, system)
    if record is None:
        return f"not run<br>{paper}"
    final = summarize_record(record, TASKS[task])
    mark = " *" if changed_settings(record) else ""
    seeds = f"{final['seeds']} seed{'s' * (final['seeds'] > 1)}{stopped(record)}"
    if cut_seeds(record):
        share = record["env_steps"][-1] / record["config"]["total_env_steps"]
        seeds += f", {share:.0%} of the steps"
    return f"{final['mean']:.1f} ± {final['std']:.1f} ({seeds}){mark}<br>{paper}"


def main() -> None:
    """Print the cells, or the commands that are left."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--commands", action="store_true", help="print a command for each missing seed"
    )
    wants_commands = parser.parse_args().commands
    for cell in cells():
        missing = cell.missing()
        if wants_commands:
            print(*(cell.command(seed) for seed in missing), sep="\n", end="\n" * bool(missing))
        else:
            have = cell.seeds - len(missing)
            print(f"{cell.task:34}{cell.name:26}{have:3} of {cell.seeds}")


if __name__ == "__main__":
    main()
