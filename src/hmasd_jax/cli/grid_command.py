"""The command `grid`: a sweep for each value of a setting."""

from hmasd_jax.cli import train_commands
from hmasd_jax.cli.hints import suggest_next
from hmasd_jax.cli.options import GridOptions, SweepOptions
from hmasd_jax.cli.parse import drop_options
from hmasd_jax.config import TrainConfig, build, change
from hmasd_jax.runs.folder import RunError


def grid(config: TrainConfig, options: GridOptions, words: list[str]) -> int:
    """Run `seed_sweep` for each value of a setting in turn and return the worst exit code.

    All values are checked before the first sweep starts. Each has a run folder named after it.
    """
    name, values = options.cells
    root = options.run_dir or train_commands.default_folder(config)
    runs = {value: root / f"{name.rpartition('.')[2]}_{value}" for value in values}
    cells = {value: change(config, {name: value}) for value in values}
    for cell in cells.values():
        build(cell)
    started = [value for value in values if runs[value].exists()]
    if started and not options.resume:
        raise RunError(
            f"{runs[started[0]]} exists: continue with --resume, or choose another --run-dir"
        )
    shared = drop_options(words[1:], "vary", "run-dir", "resume")
    codes = []
    for value, cell in cells.items():
        sweep = SweepOptions(
            run_dir=runs[value],
            resume=value in started,
            tensorboard=options.tensorboard,
            wandb=options.wandb,
        )
        line = ["seed_sweep", *shared, f"--{name}", value, "--run-dir", str(runs[value])]
        codes.append(train_commands.seed_sweep(cell, sweep, line))
        if codes[-1] == train_commands.INTERRUPTED:
            break
    if len(codes) == len(cells) and not any(codes):
        suggest_next("compare", *runs.values())
    return max(codes)
