"""Records of training runs: what produced them, their evaluations and their training metrics."""

import json
import re
import shlex
from collections.abc import Sequence
from itertools import chain, pairwise
from pathlib import Path
from statistics import fmean
from typing import Any

from hmasd_jax.analysis.learning import main_metric
from hmasd_jax.runs import folder as run_folder
from hmasd_jax.runs import metrics_log

NUM_PARTS = 10
"""Equal parts of a run over which training metrics are averaged."""
PER_SEED = ("values", "training_means", "wall_seconds", "later_commits")
"""Entries of a record with one item per seed."""
NOT_MEANS = ("kind", "seed", "env_steps", "wall_seconds", "episodes", "env_steps_per_second")
"""Entries of a training record that are not metrics to average."""


def record(run: Path) -> dict[str, Any]:
    """Return the record of a run: what produced it, evaluations (seeds, steps), and training.

    Raises:
        ValueError: not a run folder, or a seed cannot be recorded beside the others.
    """
    seeds = run_folder.seeds_of(run)
    if not seeds or not (run / "run.json").is_file():
        raise ValueError(f"RUN must be the folder of a run, but {run} holds no run.json and seeds")
    about, config = (json.loads((run / f"{name}.json").read_text()) for name in ("run", "config"))
    later = {entry["commit"]: None for entry in about.get("resumed", [])}
    later.pop(about.get("commit"), None)
    joined, *others = (_record_of_seed(run, seed, [*later]) for seed in seeds)
    for seed, other in zip(seeds[1:], others):
        joined |= _join(joined, other, f"seed {seed} of {run}")
    about = {name: value for name, value in about.items() if name != "resumed"}
    found = {**about, "command": plain_command(about["command"]), "config": config, **joined}
    if recorded_seeds(found) != seeds:  # A folder may hold seeds that were trained one by one.
        found["command"] = _name_seeds(any_seed(found["command"]), found, seeds)
    return found


def _record_of_seed(run: Path, seed: int, later_commits: list[str]) -> dict[str, Any]:
    """Return what a record has of one seed, as lists with one item.

    `later_commits` are those at which the run was resumed.
    """
    records = metrics_log.read(run_folder.metrics_path(run, seed))
    evaluations = [entry for entry in records if entry["kind"] == "eval"]
    if not evaluations:
        raise ValueError(f"seed {seed} of {run} has no evaluation: continue it with --resume")
    metric = main_metric(evaluations[-1])
    return {
        "metric": metric,
        "env_steps": [entry["env_steps"] for entry in evaluations],
        "values": [[round(entry[metric], 6) for entry in evaluations]],
        "training_means": [training_means(records)],
        "wall_seconds": [records[-1]["wall_seconds"]],
        "later_commits": [later_commits],
    }


def record_together(runs: list[Path]) -> dict[str, Any]:
    """Return one record of `runs`, whose commands differ only in what `any_seed` removes.

    Runs that were resumed to more steps count with their last number of steps.

    Raises:
        ValueError: a run cannot be recorded, or differs from the first in its command, commit or
            evaluations.
    """
    first, *others = (record(run) for run in runs)
    if not others:
        return first
    joined, command = first, any_seed(first["command"])
    for run, other in zip(runs[1:], others):
        if (any_seed(other["command"]), other["commit"]) != (command, first["commit"]):
            raise ValueError(f"{run} must have the command and the commit of {runs[0]}")
        joined |= _join(joined, other, str(run))
    seeds = [seed for run in runs for seed in run_folder.seeds_of(run)]
    return joined | {"command": _name_seeds(command, first, seeds)}


def add_seeds(earlier: dict[str, Any], runs: list[Path]) -> dict[str, Any]:
    """Return a record with the seeds of `runs` behind those of `earlier`.

    The runs may be of a later commit and of another processor, which rounds differently. The record
    has `commits`, `cpus` and `devices`, one per seed.

    Raises:
        ValueError: a run cannot be recorded, has another command or other evaluations than
            `earlier`, or a seed that `earlier` has, too.
    """
    new = record_together(runs)
    command = any_count(earlier["command"])
    if any_count(new["command"]) != command:
        raise ValueError(f"{runs[0]} must have the command of the record: {earlier['command']}")
    seeds = recorded_seeds(earlier), recorded_seeds(new)
    twice = sorted(set(seeds[0]) & set(seeds[1]))
    if twice:
        raise ValueError(f"seed {twice[0]} is in the record already")
    return {
        **earlier,
        **_join(earlier, new, str(runs[0])),
        "command": _name_seeds(command, new, [*seeds[0], *seeds[1]]),
        **{
            f"{name}s": of_each_seed(earlier, name) + of_each_seed(new, name)
            for name in ("commit", "cpu", "device")
        },
    }


def _join(first: dict[str, Any], second: dict[str, Any], name: str) -> dict[str, Any]:
    """Put what `second` has of each seed behind that of `first`.

    A seed may have fewer evaluations than others if it had no reward in half of the steps.

    Raises:
        ValueError: a seed was not evaluated at the steps of the others; `name` is that of `second`.
    """
    steps = max(first["env_steps"], second["env_steps"], key=len)
    for part in (first, second):
        own = part["env_steps"]
        rewarded = any(had_reward(part, seed) for seed in range(len(part["values"])))
        may_end = own == steps or (2 * own[-1] >= steps[-1] and not rewarded)
        if own != steps[: len(own)] or not may_end:
            raise ValueError(
                f"{name} was not evaluated at the steps of the others: finish all with --resume"
            )
    return {
        "env_steps": steps,
        **{name: _per_seed(first, name) + _per_seed(second, name) for name in PER_SEED},
    }


def _per_seed(record: dict[str, Any], name: str) -> list[Any]:
    """Return an entry with one item per seed. Earlier records have no `later_commits`."""
    return record.get(name) or [[] for _ in record["values"]]


def had_reward(record: dict[str, Any], seed: int) -> bool:
    """Return whether the seed at a position of a record had reward, in training or evaluation."""
    means = record.get("training_means")  # The oldest records have none.
    training = means[seed].get("team_reward", []) if means else []
    return any(record["values"][seed]) or any(training)


def stopped(record: dict[str, Any]) -> str:
    """Return how many seeds of a record were stopped without reward, for behind their number."""
    count = sum(not had_reward(record, seed) for seed in _ended_early(record))
    return f", {count} stopped" if count else ""


def cut_seeds(record: dict[str, Any]) -> list[int]:
    """Return the positions of the seeds that had reward and ended before the budget."""
    return [seed for seed in _ended_early(record) if had_reward(record, seed)]


def _ended_early(record: dict[str, Any]) -> list[int]:
    """Return the positions of the seeds that have no evaluation at the end of the budget."""
    config, steps = record["config"], record["env_steps"]
    last = config["total_env_steps"] - config["eval_interval"]
    ends = (steps[len(values) - 1] for values in record["values"])
    return [seed for seed, end in enumerate(ends) if end <= last]


def _name_seeds(command: str, record: dict[str, Any], seeds: list[int]) -> str:
    """Return the command of several runs, with the steps of `record`."""
    steps, numbers = record["config"]["total_env_steps"], ",".join(map(str, seeds))
    return f"{command} --total-env-steps {steps} --seed-index I for I = {numbers}"


def of_each_seed(record: dict[str, Any], name: str) -> list[Any]:
    """Return the commit, the processor or the device (`name`) of each seed of a record."""
    return record.get(f"{name}s") or [record.get(name)] * len(record["values"])


def commits_of(record: dict[str, Any]) -> list[str]:
    """Return the commits that trained the seeds of a record, each once."""
    later = chain.from_iterable(_per_seed(record, "later_commits"))
    return [*dict.fromkeys([*of_each_seed(record, "commit"), *later])]


def recorded_seeds(record: dict[str, Any]) -> list[int]:
    """Return the indices of the seeds of a record, from its command."""
    command = record["command"]
    if " for I = " in command:
        return [int(seed) for seed in command.partition(" for I = ")[2].split(",")]
    single = re.search(r" --seed-index (\d+)", command)
    return [int(single[1])] if single else list(range(len(record["values"])))


def plain_command(words: Sequence[str]) -> str:
    """Return the text of a command, with each option in the form `--its-name value`."""
    plain: list[str] = []
    for word in words:
        if word.startswith("--"):
            name, *value = word.split("=", 1)
            plain += [name.replace("_", "-"), *value]
        else:
            plain.append(word)
    return shlex.join(plain)


def any_count(command: str) -> str:
    """Return the command that trains one of the seeds, of however many."""
    command = any_seed(command.partition(" for I = ")[0]).replace(" seed_sweep ", " train ")
    return re.sub(r" --num-seeds \S+", "", command)


def any_seed(command: str) -> str:
    """Remove the seed, the number of steps and the run folder from a command."""
    return re.sub(r" --(seed-index|total-env-steps|run-dir) ('[^']*'|\S+)", "", command)


def training_means(records: list[dict[str, Any]]) -> dict[str, list[float | None]]:
    """Average each training metric over ten equal parts of a run; None where it has no values."""
    lines = [entry for entry in records if entry["kind"] == "train"]
    names = dict.fromkeys(name for entry in lines for name in entry if name not in NOT_MEANS)
    bounds = [len(lines) * part // NUM_PARTS for part in range(NUM_PARTS + 1)]
    means = {name: [] for name in names}
    for start, end in pairwise(bounds):
        for name, kept in means.items():
            values = [entry[name] for entry in lines[start:end] if name in entry]
            kept.append(float(f"{fmean(values):.4g}") if values else None)
    return means
