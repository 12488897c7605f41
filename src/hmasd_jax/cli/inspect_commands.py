"""The commands that look at runs: `evaluate`, `render`, `plot` and `compare`."""

import jax
from rich.console import Console
from rich.table import Table

from hmasd_jax import config as configs
from hmasd_jax.cli.options import CompareOptions, EvaluateOptions, PlotOptions, RenderOptions
from hmasd_jax.rl.evaluate import evaluate as play
from hmasd_jax.runs import checkpoint
from hmasd_jax.runs import folder as run_folder
from hmasd_jax.runs.folder import RunError
from hmasd_jax.runs.load import load_run
from hmasd_jax.training.compiled import evaluation_key
from hmasd_jax.types import Key, Metrics


def evaluate(options: EvaluateOptions) -> int:
    """Play with the newest checkpoint of every seed and print a table; the exit code.

    With the run's own number of episodes, and greedily, the numbers are those that the run's
    evaluation at that step gave.
    """
    config = run_folder.read_config(options.run)
    episodes = options.episodes or config.eval_episodes
    folders = {
        i: run_folder.checkpoint_folder(options.run, i) for i in run_folder.seeds_of(options.run)
    }
    ready = [
        index for index, folder in folders.items() if checkpoint.latest_step(folder) is not None
    ]
    if not ready:
        raise RunError(f"{options.run} has no checkpoint yet: wait for the first one")
    env, algorithm = configs.build(config)

    @jax.jit
    def evaluation(state: object, key: Key) -> Metrics:
        policy = algorithm.policy(state, greedy=not options.sampled)
        return play(env, policy, key, episodes)

    rows = []
    for index in ready:
        trained = load_run(options.run, index)
        metrics = evaluation(trained.state, evaluation_key(config, index, trained.env_steps))
        rows.append((index, trained.env_steps, {k: float(v) for k, v in metrics.items()}))
    how = "sampled" if options.sampled else "greedy"
    table = Table("seed", "env steps", *rows[0][2], title=f"{episodes} {how} episodes per seed")
    for index, env_steps, numbers in rows:
        table.add_row(str(index), f"{env_steps:,}", *(f"{x:.3f}" for x in numbers.values()))
    console = _console()
    console.print(table)
    for index in sorted(set(folders) - set(ready)):
        console.print(f"seed {index} has no checkpoint yet", highlight=False)
    return 0


def render(options: RenderOptions) -> int:
    """Draw episodes as a GIF; the exit code."""
    from hmasd_jax.analysis.render import render_run  # the drawing packages are optional

    print(render_run(**vars(options)))
    return 0


def plot(options: PlotOptions) -> int:
    """Plot learning curves of runs; the exit code."""
    from hmasd_jax.analysis.curves import plot_runs

    print(plot_runs(options.runs, options.out, options.metric))
    return 0


def compare(options: CompareOptions) -> int:
    """Compare runs on one task; the exit code."""
    from hmasd_jax.analysis.compare import compare_runs, tables

    comparison = compare_runs(options.runs, options.metric, options.last, options.solved_at)
    console = _console()
    for table in tables(comparison):
        console.print(table)
    print(comparison.draw(options.out))
    return 0


def _console() -> Console:
    """As wide as the terminal; wide enough for any table where there is none."""
    console = Console()
    return console if console.is_terminal else Console(width=200)
