"""The command `grid`: a sweep for each combination of values of some settings."""

from hmasd_jax.cli import train_commands
from hmasd_jax.cli.hints import suggest_next
from hmasd_jax.cli.options import GridOptions, SweepOptions
from hmasd_jax.cli.parse import drop_options
from hmasd_jax.config import TrainConfig, build, change
from hmasd_jax.runs.folder import RunError


def grid(config: TrainConfig, options: GridOptions, words: list[str]) -> int:
    """Run `seed_sweep` for each cell of the grid in turn and return the worst exit code.

    All cells are checked before the first sweep starts. Each has a run folder named after it.
    """
    root = options.run_dir or train_commands.default_folder(config)
    cells = {root / name_cell(cell): cell for cell in options.cells}
    configs = {run: change(config, cell) for run, cell in cells.items()}
    for cell_config in configs.values():
        build(cell_config)
    started = [run for run in cells if run.exists()]
    if started and not options.resume:
        raise RunError(f"{started[0]} exists: continue with --resume, or choose another --run-dir")
    shared = drop_options(words[1:], "vary", "run-dir", "resume")
    codes = []
    for run, cell in cells.items():
        sweep = SweepOptions(
            run_dir=run,
            resume=run in started,
            tensorboard=options.tensorboard,
            wandb=options.wandb,
        )
        changes = [word for name, value in cell.items() for word in (f"--{name}", value)]
        line = ["seed_sweep", *shared, *changes, "--run-dir", str(run)]
        codes.append(train_commands.seed_sweep(configs[run], sweep, line))
        if codes[-1] == train_commands.INTERRUPTED:
            break
    if len(codes) == len(cells) and not any(codes):
        suggest_next("compare", *cells)
    return max(codes)


def name_cell(cell: dict[str, str]) -> str:
    """Return the name of the run folder of a cell: its settings, without their tables."""
    return "_".join(f"{name.rpartition('.')[2]}_{value}" for name, value in cell.items())
