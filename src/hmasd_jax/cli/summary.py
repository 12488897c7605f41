"""The end of a run: summary.json, a table on the console, and the learning curves."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from envs_jax.optional import MissingPackageError
from hmasd_jax.analysis.curves import plot_runs
from hmasd_jax.analysis.learning import LAST, main_metric
from hmasd_jax.analysis.statistics import few_seeds, seed_score
from hmasd_jax.config import ConfigError, read_table, subtable
from hmasd_jax.runs import metrics_log
from hmasd_jax.runs.folder import LOCK, exclusive, metrics_path, seeds_of, write_json
from hmasd_jax.training.job import Event


def write(run: Path, results: dict[int, Event]) -> None:
    """Write RUN/summary.json from the metrics on disk.

    Other seeds keep the status that they had.

    Args:
        run: Folder of the run.
        results: Last event of each seed.
    """
    path = run / "summary.json"
    with exclusive(run / LOCK):  # Another process may end another seed.
        seeds: dict[str, dict[str, Any]] = {str(i): summarize(run, i) for i in seeds_of(run)}
        ends = {str(index): {"status": e.kind, **e.data} for index, e in results.items()}
        for name, end in (_read_ends(path) | ends).items():
            seeds.setdefault(name, {}).update(end)
        write_json(path, {"seeds": seeds, "over_seeds": over_seeds(seeds)})


def _read_ends(path: Path) -> dict[str, dict[str, Any]]:
    """Read how each seed ended; nothing if the summary is absent or damaged."""
    try:
        seeds = subtable(read_table(path), "seeds")
    except ConfigError:
        return {}
    return {
        name: {key: seed[key] for key in ("status", "message") if key in seed}
        for name, seed in seeds.items()
        if isinstance(seed, dict) and "status" in seed
    }


def summarize(run: Path, index: int) -> dict[str, Any]:
    """Return the last evaluation of one seed and the mean of its last few; empty if it has none.

    The mean leaves out the evaluation at step 0, unless there is no other.
    """
    records = metrics_log.read(metrics_path(run, index))
    evaluations = [record for record in records if record["kind"] == "eval"]
    metric = main_metric(evaluations[-1]) if evaluations else ""
    values = [record[metric] for record in evaluations if metric in record]
    if not values:
        return {}
    trained = [r[metric] for r in metrics_log.evaluations(records) if metric in r] or values
    return {
        "env_steps": records[-1]["env_steps"],
        "wall_seconds": records[-1]["wall_seconds"],
        "metric": metric,
        "final": values[-1],
        "last_evaluations": seed_score(trained, LAST),
        "num_averaged": min(LAST, len(trained)),
        "best": max(values),
    }


def over_seeds(seeds: dict[str, Any]) -> dict[str, float]:
    """Return means and (population) standard deviations over seeds, which the paper reports."""
    known = [seed for seed in seeds.values() if "final" in seed]
    names = ("final", "last_evaluations") if known else ()
    values = {name: [seed[name] for seed in known] for name in names}
    means = {f"{name}_mean": float(np.mean(v)) for name, v in values.items()}
    return means | {f"{name}_std": float(np.std(v)) for name, v in values.items()}


def table(run: Path) -> Table:
    """Return a table with one row per seed, and one over all seeds."""
    seeds = {index: summarize(run, index) for index in seeds_of(run)}
    known = {index: seed for index, seed in seeds.items() if seed}
    metric = next(iter(known.values()))["metric"] if known else "success"
    counts = {seed["num_averaged"] for seed in known.values()} or {LAST}
    last = f"last {' or '.join(map(str, sorted(counts)))} evaluations"
    last = "last evaluation" if counts == {1} else last
    result = Table("seed", "env steps", f"final {metric}", last, "seconds")
    for index, seed in known.items():
        numbers = (f"{seed['final']:.3f}", f"{seed['last_evaluations']:.3f}")
        result.add_row(
            str(index), f"{seed['env_steps']:,}", *numbers, f"{seed['wall_seconds']:,.0f}"
        )
    if len(known) > 1:
        over = over_seeds({str(k): v for k, v in known.items()})
        spread = [
            f"{over[f'{n}_mean']:.3f} ± {over[f'{n}_std']:.3f}"
            for n in ("final", "last_evaluations")
        ]
        result.add_section()
        result.add_row("mean ± std", "", *spread, "")
        result.caption = few_seeds(len(known))
    return result


def plot(console: Console, run: Path) -> None:
    """Write RUN/curves.png, or print which package is missing for it."""
    metrics = [s["metric"] for s in map(partial(summarize, run), seeds_of(run)) if s]
    if not metrics:
        return
    try:
        out = plot_runs([run], run / "curves.png", metrics[0])
        console.print(f"curves: {out}", markup=False, highlight=False, soft_wrap=True)
    except MissingPackageError as error:
        console.print(f"no curves.png: {error}", markup=False, soft_wrap=True)
