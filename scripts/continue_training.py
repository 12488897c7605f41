"""Record how training goes on from a checkpoint, with other settings and other random numbers.

python scripts/continue_training.py RUN OUT --seed 1 --step 400000 --set algorithm.solved.balance=0

OUT (JSON) gets one row per repetition: the success in training, in percent, over every five
updates, or the mean team reward of a step where the environment counts no success. Copies that act
greedily count, too.
Repetitions differ in their random numbers alone. The settings must leave the shapes of the train
state as they are.
"""

import argparse
from collections import defaultdict
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hmasd_jax import config as configs
from hmasd_jax.config.from_table import Text
from hmasd_jax.rl.keys import key_beside
from hmasd_jax.runs.load import load_run
from hmasd_jax.training.compiled import build_executable
from hmasd_jax.types import Metrics
from scripts.records import checkpoint_parser, describe_script, write_rows

POOLED = 5
"""Updates per number."""
SUCCESS = "episode_sum/success"
UNUSED = 2
"""Number from which on `key_beside` makes keys that training does not use."""


def continue_training(
    run: Path, seed: int, step: int, settings: dict[str, Any], num_updates: int, repetitions: int
) -> list[dict[str, Any]]:
    """Return one row per repetition of the updates after the checkpoint of a step."""
    state = load_run(run, seed, step).state
    _, algorithm = configs.build(configs.load(run / "config.json", settings))

    @jax.jit
    def updates(state):
        state, metrics = jax.lax.scan(lambda s, _: algorithm.update(s), state, length=POOLED)
        return state, score(metrics)

    run_updates = build_executable(updates, state)
    rows = []
    for repetition in range(repetitions):
        # Training itself uses the first keys beside its own.
        now = state._replace(key=key_beside(state.key, UNUSED + repetition))
        scores = defaultdict(list)
        for _ in range(num_updates // POOLED):
            now, pooled = run_updates(now)
            for name, value in pooled.items():
                # None where no episode ended.
                scores[name].append(None if np.isnan(value) else round(float(value), 4))
        rows.append({"repetition": repetition, **scores})
    return rows


def score(metrics: Metrics) -> Metrics:
    """Return the success of the pooled updates in percent, or their team reward without one."""
    if SUCCESS not in metrics:
        return {"team_reward": metrics["team_reward"].mean()}
    return {"success": 100 * metrics[SUCCESS].sum() / metrics["episodes"].sum()}


def read_setting(text: str) -> tuple[str, Text]:
    """Split NAME=VALUE."""
    name, sign, value = text.partition("=")
    if not sign:
        raise argparse.ArgumentTypeError(f"write NAME=VALUE, got {text!r}")
    return name, Text(value)


def main() -> None:
    """Read the arguments, go on, and write the record."""
    parser = checkpoint_parser(__doc__, "folder of a run", updates=100)
    parser.add_argument(
        "--set", nargs="*", action="extend", default=[], type=read_setting, metavar="NAME=VALUE",
        help="other settings",
    )  # fmt: skip
    parser.add_argument("--repetitions", type=int, default=4, help="times to do them")
    args = parser.parse_args()
    if args.updates < 1 or args.updates % POOLED:
        parser.error(f"--updates {args.updates} is not a multiple of {POOLED}")
    about = describe_script(args.run)
    rows = continue_training(
        args.run, args.seed, args.step, dict(args.set), args.updates, args.repetitions
    )
    write_rows(args.out, about, rows)


if __name__ == "__main__":
    main()
