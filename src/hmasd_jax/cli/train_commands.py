"""The commands `train` and `seed_sweep`, from settings to finished runs."""

import dataclasses
import time
from pathlib import Path

from rich.console import Console

from hmasd_jax.cli import summary
from hmasd_jax.cli.hints import shell_command, write_command
from hmasd_jax.cli.options import RunOptions, SweepOptions, TrainOptions
from hmasd_jax.config import TrainConfig, build, identity, name_differences, to_json
from hmasd_jax.hmasd.config import count_skills
from hmasd_jax.runs.folder import (
    RunError,
    check_unlocked,
    create,
    note_resume,
    read_config,
    seeds_of,
)
from hmasd_jax.runs.metrics_log import check_loggers
from hmasd_jax.training import distributed
from hmasd_jax.training.distributed import ALONE, Group
from hmasd_jax.training.executable_cache import use_cache
from hmasd_jax.training.job import Event, Job, Watcher
from hmasd_jax.training.loop import choose_placement, train_seeds
from hmasd_jax.training.progress import Display
from hmasd_jax.training.schedule import make_plan
from hmasd_jax.training.signals import stop_on_signal
from hmasd_jax.training.workers import run_workers, worker_cores

INTERRUPTED = 130
FAILED = 1


def train(config: TrainConfig, options: TrainOptions, words: list[str]) -> int:
    """Train one seed and return the exit code."""
    placement = "workers" if config.placement == "workers" else "this process"
    index = choose_seed(options)
    options = dataclasses.replace(options, seed_index=index)
    return _experiment(config, options, words, [index], placement)


def choose_seed(options: TrainOptions) -> int:
    """Return the index of the seed to train: as given, else that of the resumed run, else 0.

    Raises:
        RunError: The resumed run has several seeds, and seed 0 is none of them.
    """
    if options.seed_index is not None:
        return options.seed_index
    run = options.resumed_run
    known = seeds_of(run) if run is not None else []
    if len(known) > 1 and 0 not in known:
        found = ", ".join(map(str, known))
        raise RunError(f"{run} has the seeds {found}: choose one to resume by --seed-index")
    return known[0] if len(known) == 1 else 0


def seed_sweep(config: TrainConfig, options: SweepOptions, words: list[str]) -> int:
    """Train seeds 0 .. num_seeds - 1 and return the exit code."""
    if options.distributed and options.run_dir is None:
        raise RunError("--distributed needs --run-dir, a folder that all processes can see")
    group = distributed.join() if options.distributed else ALONE
    seeds = list(range(config.num_seeds))
    return _experiment(config, options, words, seeds, choose_placement(config), group)


def _experiment(
    config: TrainConfig,
    options: RunOptions,
    words: list[str],
    seeds: list[int],
    placement: str,
    group: Group = ALONE,
) -> int:
    """Prepare the run folder, train and summarize; return the exit code.

    Its arguments are those of `run_seeds`.
    """
    check_loggers(options.loggers)
    build(config)  # Before a folder is created: settings may not fit.
    run = options.run_dir or create_default_folder(config)
    options = dataclasses.replace(options, run_dir=run)
    results = run_seeds(config, options, words, seeds, placement, group)
    if not group.leads:
        return exit_code(results)
    again = write_command(words[0], "--run-dir", run, "--resume", *options.repeated)
    return conclude(Console(), run, results, again)


def run_seeds(
    config: TrainConfig,
    options: RunOptions,
    words: list[str],
    seeds: list[int],
    placement: str,
    group: Group = ALONE,
    watcher: Watcher | None = None,
) -> dict[int, Event]:
    """Prepare the run folder and train; return the last event of each seed.

    Args:
        config: Settings of the run.
        options: Options of the command, `run_dir` included.
        words: Command line, the command's name first.
        seeds: Indices of the seeds, those of other processes included.
        placement: Placement of the seeds; `workers` starts processes, any other trains in this one.
        group: Processes that share the seeds.
        watcher: Follows the training and may end it.
    """
    env, algorithm = build(config)
    console, run = Console(quiet=not group.leads), options.run_dir
    assert run is not None
    _prepare(run, config, seeds, options.resume, shell_command(*words), group)
    distributed.leave(group)
    mine = group.share(seeds)
    text = describe(config, seeds, run, placement, group)
    for line in filter(None, (text, use_cache())):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    display = Display(console, mine, make_plan(config).env_steps)
    watchers = [display] if watcher is None else [display, watcher]

    def report(event: Event) -> None:
        for each in watchers:
            each.handle(event)

    with stop_on_signal() as interrupted:
        job = Job(
            run=run,
            config=config,
            env=env,
            algorithm=algorithm,
            loggers=options.loggers,
            report=report,
            should_stop=lambda: interrupted() or (watcher is not None and watcher.should_stop()),
        )
        with display, distributed.telling_failure(group, run, mine):
            if placement == "workers":
                results = run_workers(job, mine, worker_cores(len(mine)))
            else:
                results = train_seeds(job, mine)
        if group.size > 1:
            console.print("waiting for the other processes")
        return distributed.gather(group, run, seeds, results, interrupted)


def _prepare(
    run: Path, config: TrainConfig, seeds: list[int], resume: bool, line: list[str], group: Group
) -> None:
    """Create the run folder, or check that it is the run to resume; once for all processes."""
    ok = False
    try:
        if group.leads and resume:
            check_same(read_config(run), config, run)
            check_unlocked(run, seeds)  # A command that is refused must not change the run.
            note_resume(run, config, line)
            distributed.forget(group, run)
        elif group.leads:
            create(run, config, line)
        ok = True
    finally:
        ok = group.follow(ok)
    if not ok:
        raise RunError("the first process could not prepare the run: see its message")


def check_same(saved: TrainConfig, wanted: TrainConfig, run: Path) -> None:
    """Check that a run is resumed with its own configuration, or with a longer one.

    Raises:
        RunError: Settings differ; the message names them.
    """
    old, new = (dict(sorted(identity(to_json(config)).items())) for config in (saved, wanted))
    if wanted.total_env_steps < saved.total_env_steps:
        raise RunError(
            f"{run} has total_env_steps {saved.total_env_steps}, which can be raised but not "
            f"lowered to {wanted.total_env_steps}: resume without it, or choose another --run-dir"
        )
    for kind in ("env.name", "algorithm.name"):
        if old[kind] != new[kind]:  # All settings of the other one differ, too.
            old, new = {kind: old[kind]}, {kind: new[kind]}
            break
    if changes := name_differences(old, new):
        raise RunError(
            f"{run} has another configuration: {changes}; resume without these, or choose "
            "another --run-dir"
        )


def describe(
    config: TrainConfig, seeds: list[int], run: Path, placement: str, group: Group = ALONE
) -> str:
    """Return the lines that a run starts with: its folder, task, seeds and intervals."""
    plan = make_plan(config)
    if placement == "workers":
        workers = len(worker_cores(len(group.share(seeds))))
        placement += f" ({workers} single-threaded processes)"
    if group.size > 1:
        shown = ", ".join(map(str, group.share(seeds)))
        placement += f", {group.size} processes (this one trains and shows {shown})"
    per_update, names = plan.env_steps_per_update, to_json(config)
    lines = [
        f"run folder       {run}",
        f"task             {names['algorithm']['name']} on {names['env']['name']}",
        f"seeds            {len(seeds)} ({', '.join(map(str, seeds))}), placement {placement}",
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
    if names["algorithm"].get("extrinsic_coef") == 0 and names["env"]["name"] != "alice_and_bob":
        lines.append(
            "note: algorithm.extrinsic_coef is 0, so the low level is not paid the team reward, as "
            "in the paper's Alice_and_Bob; configs/alice_and_bob/hmasd_general.toml has settings "
            "for any task"
        )
    return "\n".join(lines)


def conclude(console: Console, run: Path, results: dict[int, Event], again: str) -> int:
    """Write the summary and the curves, print the remaining work and return the exit code.

    Args:
        console: Console to print on.
        run: Folder of the run.
        results: Last event of each seed.
        again: Command that resumes the run.
    """
    summary.write(run, results)
    console.print(summary.table(run))
    failed = {seed: e.data["message"] for seed, e in sorted(results.items()) if e.kind == "failed"}
    code = exit_code(results)
    for seed, message in failed.items():
        console.print(f"seed {seed} failed: {message}", markup=False, soft_wrap=True)
    if code == INTERRUPTED:
        console.print(f"interrupted; to continue: {again}", markup=False, soft_wrap=True)
        return code
    if failed:
        hint = f"to resume failed seeds from their last checkpoints: {again}"
        console.print(hint, markup=False, soft_wrap=True)
    summary.plot(console, run)
    if code == 0:
        console.print(next_step(run), markup=False, highlight=False, soft_wrap=True)
    return code


def next_step(run: Path) -> str:
    """Return a line with a command that shows what a finished run has learned."""
    first = seeds_of(run)[0]
    render = write_command("render", run, *(["--seed-index", first] if first else []))
    if any(count_skills(read_config(run).algorithm)):
        return f"see what the skills do: {render} --team-skill 0 --out skill_0.gif"
    return f"see what was learned: {render} --out episode.gif"


def exit_code(results: dict[int, Event]) -> int:
    """Return the exit code of a process whose seeds ended like this."""
    kinds = {event.kind for event in results.values()}
    return INTERRUPTED if "interrupted" in kinds else FAILED if "failed" in kinds else 0


def create_default_folder(config: TrainConfig) -> Path:
    """Create an empty folder under runs/, named after task and time.

    Raises:
        RunError: It cannot be created.
    """
    names = to_json(config)
    task = f"{names['env']['name']}-{names['algorithm']['name']}"
    folder = first = Path("runs") / f"{task}-{time.strftime('%Y%m%d-%H%M%S')}"
    number = 1
    while True:
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:  # Another command began in the same second.
            number += 1
            folder = first.with_name(f"{first.name}-{number}")
        except OSError as error:
            raise RunError(f"cannot write {folder}: {error.strerror}") from error
