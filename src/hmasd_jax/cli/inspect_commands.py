"""The commands that look at runs: `evaluate`, `render`, `plot` and `compare`.

Their packages for drawing are optional, so they are imported by the command that needs them.
"""

import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from rich.console import Console
from rich.table import Table

from hmasd_jax.cli.hints import suggest_next
from hmasd_jax.cli.options import CompareOptions, EvaluateOptions, PlotOptions, RenderOptions
from hmasd_jax.config import build, to_json
from hmasd_jax.rl.evaluate import evaluate
from hmasd_jax.runs import checkpoint
from hmasd_jax.runs.folder import RunError, checkpoint_folder, read_config, seeds_of
from hmasd_jax.training.compiled import compile_lowered, evaluation_key, lower
from hmasd_jax.training.executable_cache import load_or_compile, use_cache
from hmasd_jax.types import Key, Metrics


def evaluate_checkpoints(options: EvaluateOptions) -> int:
    """Evaluate a checkpoint of every seed, print a table and return the exit code.

    A checkpoint that is damaged or absent is told after the others are evaluated, and the code is
    then 1.

    With the run's own number of episodes and greedy policies, the numbers equal those of the run's
    evaluation at that step.
    """
    config = read_config(options.run)
    use_cache()
    episodes = options.episodes or config.eval_episodes
    folders = {index: checkpoint_folder(options.run, index) for index in seeds_of(options.run)}
    ready = {i: f for i, f in folders.items() if checkpoint.latest_step(f) is not None}
    if not ready:
        raise RunError(f"{options.run} has no checkpoint yet: wait for the first one")
    env, algorithm = build(config)
    template = checkpoint.state_template(algorithm)

    def evaluation(state: Any, key: Key) -> Metrics:
        policy = algorithm.policy(state, greedy=not options.sampled)
        return evaluate(env, policy, key, episodes)

    program = _compile(evaluation, template)
    rows, faults = [], []
    for index, folder in ready.items():
        try:
            state, env_steps = checkpoint.restore(folder, template, to_json(config), options.step)
        except checkpoint.CheckpointError as error:
            faults.append(f"seed {index}: {error}")
            continue
        metrics = program(state, evaluation_key(config, index, env_steps))
        rows.append((index, env_steps, {k: float(v) for k, v in metrics.items()}))
    if rows:
        mode = "sampled" if options.sampled else "greedy"
        _print_rows(rows, f"{episodes} {mode} episodes per seed")
    for index in sorted(folders.keys() - ready.keys()):
        print(f"seed {index} has no checkpoint yet")
    for fault in faults:
        print(f"error: {fault}", file=sys.stderr)
    if rows:
        suggest_next("render", options.run, "--out", "episode.gif")
    return 1 if faults else 0


def _compile(evaluation: Callable[[Any, Key], Metrics], template: Any) -> Callable[..., Metrics]:
    """Compile a function of a train state and a key, or load it from disk."""
    key = jax.random.key(0)

    def fill(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return jax.random.split(key, leaf.shape) if is_key else jnp.zeros(leaf.shape, leaf.dtype)

    lowered = lower(jax.jit(evaluation), template, key)
    return load_or_compile(
        [lowered],
        lambda: compile_lowered(lowered, "seldom"),
        lambda program: program(jax.tree.map(fill, template), key),
    )


def _print_rows(rows: list[tuple[int, int, dict[str, float]]], title: str) -> None:
    """Print seed, environment steps and metrics of each row as a table."""
    table = Table("seed", "env steps", *rows[0][2], title=title)
    for index, env_steps, numbers in rows:
        table.add_row(str(index), f"{env_steps:,}", *(f"{x:.3f}" for x in numbers.values()))
    _console().print(table)


def render(options: RenderOptions) -> int:
    """Draw episodes as an animation and return the exit code."""
    from hmasd_jax.analysis.render import render_run

    out = render_run(
        options.run,
        options.out,
        seed=options.seed_index,
        team_skill=options.team_skill,
        episodes=options.episodes,
        fps=options.fps,
        step=options.step,
    )
    print(out)
    suggest_next("report", options.run)
    return 0


def plot(options: PlotOptions) -> int:
    """Plot learning curves of runs and return the exit code."""
    from hmasd_jax.analysis.compare import are_one_task
    from hmasd_jax.analysis.curves import plot_runs

    print(plot_runs(options.runs, options.out, options.metric, options.show_seeds))
    can_compare = len(options.runs) > 1 and are_one_task([*map(read_config, options.runs)])
    suggest_next("compare" if can_compare else "report", *options.runs)
    return 0


def compare(options: CompareOptions) -> int:
    """Compare runs on one task and return the exit code."""
    from hmasd_jax.analysis.compare import compare_runs, tables

    comparison = compare_runs(options.runs, options.metric, options.last, options.solved_at)
    console = _console()
    for table in tables(comparison):
        console.print(table)
    print(comparison.draw(options.out, options.show_seeds))
    suggest_next("report", *options.runs)
    return 0


def _console() -> Console:
    """Return a console as wide as the terminal, or wide enough for any table if there is none."""
    console = Console()
    return console if console.is_terminal else Console(width=200)
