"""The command `grid`: a sweep for each combination of values of some settings."""

from pathlib import Path

from hmasd_jax.cli import train_commands
from hmasd_jax.cli.hints import suggest_next, write_command
from hmasd_jax.cli.options import GridOptions, SweepOptions
from hmasd_jax.cli.parse import drop_options
from hmasd_jax.config import TrainConfig, build, change
from hmasd_jax.runs.folder import RunError, check_unused, is_run
from hmasd_jax.training.signals import stop_on_signal


def grid(config: TrainConfig, options: GridOptions, words: list[str]) -> int:
    """Run `seed_sweep` for each cell of the grid in turn and return the worst exit code.

    All cells are checked before the first sweep starts. Each has a run folder named after it. A
    signal that stops a sweep also ends the grid, even if that sweep has just finished.
    """
    root = options.run_dir or train_commands.default_folder(config)
    cells = {root / name_cell(cell): cell for cell in options.cells}
    configs = {run: change(config, cell) for run, cell in cells.items()}
    for cell_config in configs.values():
        build(cell_config)
    started = [run for run in cells if is_run(run)]
    if started and not options.resume:
        raise RunError(f"{started[0]} exists: continue with --resume, or choose another --run-dir")
    for run in cells:
        if run not in started:
            check_unused(run)
    codes = []
    with stop_on_signal() as interrupted:
        for run, cell in cells.items():
            codes.append(_sweep(run, cell, configs[run], options, words, run in started))
            if codes[-1] == train_commands.INTERRUPTED or interrupted():
                break
    if len(codes) < len(cells) or train_commands.INTERRUPTED in codes:
        again = [*drop_options(words, "run-dir", "resume"), "--run-dir", str(root), "--resume"]
        print(f"interrupted; to continue: {write_command(*again)}")
        return train_commands.INTERRUPTED
    if not any(codes):
        suggest_next("compare", *cells)
    return max(codes)


def _sweep(
    run: Path,
    cell: dict[str, str],
    config: TrainConfig,
    options: GridOptions,
    words: list[str],
    resume: bool,
) -> int:
    """Train one cell and return the exit code.

    Args:
        run: Its run folder.
        cell: Its values by dotted name.
        config: Its configuration.
        options: Options of the grid.
        words: Command line of the grid.
        resume: True if it was started before.
    """
    sweep = SweepOptions(
        run_dir=run, resume=resume, tensorboard=options.tensorboard, wandb=options.wandb
    )
    shared = drop_options(words[1:], "vary", "run-dir", "resume")
    changes = [word for name, value in cell.items() for word in (f"--{name}", value)]
    line = ["seed_sweep", *shared, *changes, "--run-dir", str(run)]
    return train_commands.seed_sweep(config, sweep, line)


def name_cell(cell: dict[str, str]) -> str:
    """Return the name of the run folder of a cell: its settings, without their tables."""
    return "_".join(f"{name.rpartition('.')[2]}_{value}" for name, value in cell.items())
