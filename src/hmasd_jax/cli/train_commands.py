"""The commands that train: `train`, `seed_sweep` and `grid`, from settings to finished runs."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

from hmasd_jax import config as configs
from hmasd_jax.cli import summary
from hmasd_jax.cli.options import (
    GridOptions,
    RunOptions,
    SweepOptions,
    TrainOptions,
    drop_options,
)
from hmasd_jax.config import TrainConfig
from hmasd_jax.config.from_table import Text
from hmasd_jax.runs import folder as run_folder
from hmasd_jax.runs import metrics_log as logging
from hmasd_jax.training import distributed
from hmasd_jax.training import workers as sweep
from hmasd_jax.training.distributed import ALONE, Group
from hmasd_jax.training.loop import Event, Job, choose_layout, train_seeds
from hmasd_jax.training.progress import Display
from hmasd_jax.training.schedule import make_plan

INTERRUPTED = 130
FAILED = 1


def train(config: TrainConfig, options: TrainOptions, words: list[str]) -> int:
    """Train one seed; the exit code."""
    return _experiment("train", config, options, words, [options.seed_index])


def seed_sweep(config: TrainConfig, options: SweepOptions, words: list[str]) -> int:
    """Train seeds 0 .. num_seeds - 1; the exit code."""
    seeds = list(range(config.num_seeds))
    if not options.distributed:
        return _experiment("seed_sweep", config, options, words, seeds)
    if options.run_dir is None:
        raise run_folder.RunError("--distributed needs --run-dir, a folder all processes can see")
    return _experiment("seed_sweep", config, options, words, seeds, distributed.join())


def grid(config: TrainConfig, options: GridOptions, words: list[str]) -> int:
    """`seed_sweep` for every value of a setting, one after the other; the worst exit code.

    Nothing is begun unless all values can be. Each has a run folder named after it.
    """
    name, values = options.cells
    root = options.run_dir or _default_folder(config)
    runs = {value: root / f"{name.rpartition('.')[2]}_{value}" for value in values}
    cells = {
        value: configs.from_json(configs.override(configs.to_json(config), {name: Text(value)}))
        for value in values
    }
    for cell in cells.values():
        configs.build(cell)
    begun = [value for value in values if runs[value].exists()]
    if begun and not options.resume:
        raise run_folder.RunError(
            f"{runs[begun[0]]} exists: continue with --resume, or choose another --run-dir"
        )
    words = drop_options(words, "vary", "run-dir", "resume")
    codes = []
    for value, cell in cells.items():
        one = replace(options, run_dir=runs[value], resume=value in begun)
        line = [*words, f"--{name}", value, "--run-dir", str(runs[value])]
        codes.append(_experiment("seed_sweep", cell, one, line, list(range(cell.num_seeds))))
        if codes[-1] == INTERRUPTED:
            break
    return max(codes)


def _experiment(
    command: str,
    config: TrainConfig,
    options: RunOptions,
    words: list[str],
    seeds: list[int],
    group: Group = ALONE,
) -> int:
    """Prepare the folder, train, summarize."""
    extras = tuple(name for name in ("tensorboard", "wandb") if getattr(options, name))
    logging.check_extras(extras)
    configs.build(config)  # refuses what does not fit the environment before anything is written
    console = Console(quiet=not group.leads)
    run = options.run_dir or _default_folder(config)
    line = run_folder.shell_command([command, *words])
    _prepare(run, config, options.resume, line, group)
    keep_executables()
    mine = group.share(seeds)
    text = describe(config, seeds, run, command, group)
    console.print(text, markup=False, highlight=False, soft_wrap=True)
    display = Display(console, mine, make_plan(config).env_steps)
    with stop_on_signal() as should_stop, display:
        job = Job(run, config, extras, display.handle, should_stop)
        alone = command == "train" and config.layout != "workers"
        results = train_seeds(job, mine) if alone else sweep.run_sweep(job, mine)
    results = distributed.gather(group, run, results)
    return conclude(console, run, results, command) if group.leads else exit_code(results)


def _prepare(run: Path, config: TrainConfig, resume: bool, line: list[str], group: Group) -> None:
    """Make the run folder, or insist that it is the one to continue; once for all processes."""
    ok = False
    try:
        if group.leads and resume:
            check_same(run_folder.read_config(run), config, run)
            run_folder.note_resume(run, config, line)
            distributed.forget(group, run)
        elif group.leads:
            run_folder.create(run, config, line)
        ok = True
    finally:
        ok = group.follow(ok)
    if not ok:
        raise run_folder.RunError("the first process could not prepare the run: see its message")


def keep_executables() -> None:
    """Let JAX keep compiled programs for the next start, unless it was told where to already.

    Not on a CPU: what is stored there holds for one kind of processor only, and XLA's check of that
    cannot be relied on (jax issue 38445).
    """
    told = jax.config.values["jax_compilation_cache_dir"]
    if jax.default_backend() != "cpu" and told is None:
        folder = Path.home() / ".cache" / "hmasd_jax"
        jax.config.update("jax_compilation_cache_dir", str(folder))


def check_same(saved: TrainConfig, wanted: TrainConfig, run: Path) -> None:
    """Insist that a run is continued with the configuration it began with, or extended.

    Raises:
        RunError: naming the fields that differ.
    """
    old, new = (configs.identity(configs.to_json(c)) for c in (saved, wanted))
    if wanted.total_env_steps < saved.total_env_steps:
        raise run_folder.RunError(
            f"{run} has total_env_steps {saved.total_env_steps}, which can be raised but not "
            f"lowered to {wanted.total_env_steps}: resume without it, or choose another --run-dir"
        )
    changed = [k for k in sorted(old | new) if old.get(k) != new.get(k)]
    if changed:
        changes = ", ".join(f"{k} (was {old.get(k)}, now {new.get(k)})" for k in changed)
        raise run_folder.RunError(
            f"{run} has another configuration: {changes}; resume without these, or choose "
            "another --run-dir"
        )


def describe(
    config: TrainConfig, seeds: list[int], run: Path, command: str, group: Group = ALONE
) -> str:
    """What follows from the configuration."""
    plan = make_plan(config)
    layout: str = choose_layout(config)
    if command == "train" and config.layout != "workers":
        layout = "this process"
    if layout == "workers":
        workers = len(sweep.worker_cores(len(group.share(seeds))))
        layout += f" ({workers} single-threaded processes)"
    if group.size > 1:
        shown = ", ".join(map(str, group.share(seeds)))
        layout += f", {group.size} processes (this one trains and shows {shown})"
    per_update, names = plan.env_steps_per_update, configs.to_json(config)
    lines = [
        f"run folder       {run}",
        f"task             {names['algorithm']['name']} on {names['env']['name']}",
        f"seeds            {len(seeds)} ({', '.join(map(str, seeds))}), layout {layout}",
        f"updates          {plan.num_updates:,} of {per_update:,} env steps",
        f"env steps        {plan.env_steps:,} per seed",
        f"evaluations      {plan.num_evaluations} of {config.eval_episodes} episodes, "
        f"every {plan.eval_every * per_update:,} env steps",
        f"metrics          every {plan.log_every * per_update:,} env steps",
        f"checkpoints      every {plan.checkpoint_every * per_update:,} env steps, "
        f"the last {config.keep_checkpoints} are kept",
    ]
    if plan.env_steps != config.total_env_steps:
        lines.append(
            f"note: total_env_steps {config.total_env_steps:,} is rounded down to "
            f"{plan.env_steps:,}, a multiple of the {per_update:,} env steps of one update"
        )
    return "\n".join(lines)


@contextmanager
def stop_on_signal() -> Iterator[Callable[[], bool]]:
    """Turn Ctrl-C and a polite kill into a request that training asks for between chunks."""
    asked: list[int] = []

    def ask(number: int, _: Any) -> None:
        asked.append(number)

    previous = {s: signal.signal(s, ask) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def conclude(
    console: Console,
    run: Path,
    results: dict[int, Event],
    command: str,
) -> int:
    """Write the summary and the curves, and say what is left to do; the exit code."""
    summary.write(run, results)
    console.print(summary.table(run))
    failed = {seed: e.data["message"] for seed, e in sorted(results.items()) if e.kind == "failed"}
    code = exit_code(results)
    for seed, message in failed.items():
        console.print(f"seed {seed} failed: {message}", markup=False, soft_wrap=True)
    again = f"python -m hmasd_jax.train {command} --run-dir {run} --resume"
    if code == INTERRUPTED:
        console.print(f"interrupted; to continue: {again}", markup=False, soft_wrap=True)
        return code
    if failed:
        console.print(
            f"to run what failed again from its last checkpoint: {again}",
            markup=False,
            soft_wrap=True,
        )
    summary.plot(console, run)
    return code


def exit_code(results: dict[int, Event]) -> int:
    """What the process ends with."""
    kinds = {event.kind for event in results.values()}
    return INTERRUPTED if "interrupted" in kinds else FAILED if "failed" in kinds else 0


def _default_folder(config: TrainConfig) -> Path:
    names = configs.to_json(config)
    task = f"{names['env']['name']}-{names['algorithm']['name']}"
    return Path("runs") / f"{task}-{time.strftime('%Y%m%d-%H%M%S')}"
