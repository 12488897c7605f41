"""The command `grid`: a sweep for each combination of values of some settings."""

import dataclasses

from hmasd_jax.analysis.compare import are_one_task
from hmasd_jax.cli import train_commands
from hmasd_jax.cli.hints import suggest_next, write_command
from hmasd_jax.cli.options import GridOptions, SweepOptions
from hmasd_jax.cli.parse import drop_options, load_config, parse
from hmasd_jax.config import TrainConfig, build
from hmasd_jax.runs.folder import RunError, check_unused, is_run
from hmasd_jax.training.signals import stop_on_signal


def grid(config: TrainConfig, options: GridOptions, words: list[str]) -> int:
    """Run `seed_sweep` for each cell of the grid in turn and return the worst exit code.

    All cells are checked before the first sweep starts. Each has a run folder named after it. A
    signal that stops a sweep also ends the grid, even if that sweep has just finished.
    """
    lines = {name_cell(cell): write_line(words, cell) for cell in options.cells}
    sweeps = {name: parse(SweepOptions, line[1:]) for name, line in lines.items()}
    configs = {name: load_config(*sweep) for name, sweep in sweeps.items()}
    for cell_config in configs.values():
        build(cell_config)
    root = options.run_dir or train_commands.create_default_folder(config)
    cells = {root / name: line for name, line in lines.items()}
    started = [run for run in cells if is_run(run)]
    if started and not options.resume:
        raise RunError(f"{started[0]} exists: continue with --resume, or choose another --run-dir")
    for run in cells:
        if run not in started:
            check_unused(run)
    codes = []
    with stop_on_signal() as interrupted:
        for run, line in cells.items():
            sweep, _ = sweeps[run.name]
            sweep = dataclasses.replace(sweep, run_dir=run, resume=run in started)
            whole_line = [*line, "--run-dir", str(run)]
            codes.append(train_commands.seed_sweep(configs[run.name], sweep, whole_line))
            if codes[-1] == train_commands.INTERRUPTED or interrupted():
                break
    if len(codes) < len(cells) or train_commands.INTERRUPTED in codes:
        again = [*drop_options(words, "run-dir", "resume"), "--run-dir", str(root), "--resume"]
        print(f"interrupted; to continue: {write_command(*again)}")
        return train_commands.INTERRUPTED
    if not any(codes):
        suggest_next("compare" if are_one_task([*configs.values()]) else "plot", *cells)
    return max(codes)


def write_line(words: list[str], cell: dict[str, str]) -> list[str]:
    """Return the command line that makes one cell alone, in its default folder.

    A cell has the configuration that this line asks for, so that settings given beside
    `algorithm.name` reach all algorithms.

    Args:
        words: Command line of the grid.
        cell: Values of the cell by dotted name.
    """
    shared = drop_options(words[1:], "vary", "run-dir", "resume")
    changes = [word for name, value in cell.items() for word in (f"--{name}", value)]
    return ["seed_sweep", *shared, *changes]


def name_cell(cell: dict[str, str]) -> str:
    """Return the name of the run folder of a cell: its settings, without their tables."""
    return "_".join(f"{name.rpartition('.')[2]}_{value}" for name, value in cell.items())
