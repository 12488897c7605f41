"""Record how large a share of the parts of episodes of a run has reached each value of a feature.

python scripts/frontier_shares.py RUN FEATURE OUT

RUN was trained with `algorithm.frontier`, FEATURE is an index into its global state. OUT (JSON)
gets one row per seed, direction and bin: the deviation of all bonuses so far, the bin's ends, the
largest share of parts that has reached it so far, rising or falling, and the share over the last
rollouts.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from hmasd_jax.exploration.frontier import Frontier
from hmasd_jax.exploration.visits import recent_share
from hmasd_jax.runs import folder as run_folder
from hmasd_jax.runs.load import load_run
from scripts.records import describe_script, write_rows


def list_shares(frontier: Frontier, feature: int) -> list[dict[str, float | str]]:
    """Return a row per direction and bin of one feature of the state."""
    num_bins = frontier.reached.shape[-1]
    ends = np.linspace(float(frontier.low[feature]), float(frontier.high[feature]), num_bins + 1)
    recent = recent_share(frontier.reached[:, feature], frontier.parts.sum())
    largest = np.asarray(frontier.mastered[:, feature])
    return [
        {
            "direction": direction,
            "from": round(float(ends[i]), 4),
            "to": round(float(ends[i + 1]), 4),
            "largest_share": round(float(largest[row, i]), 4),
            "recent_share": round(float(recent[row, i]), 4),
        }
        for row, direction in enumerate(("rising", "falling"))
        for i in range(num_bins)
    ]


def find_frontier(bonus: Any) -> Frontier | None:
    """Return the frontier in the state of a bonus, which is a pair if two are added."""
    parts = (bonus,) if isinstance(bonus, Frontier) else bonus
    return next((part for part in parts if isinstance(part, Frontier)), None)


def main() -> None:
    """Record the shares of all seeds of a run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run")
    parser.add_argument("feature", type=int, metavar="FEATURE", help="index into the state")
    parser.add_argument("out", type=Path, metavar="OUT", help="JSON file to write")
    args = parser.parse_args()
    about = describe_script(args.run)
    rows: list[dict[str, Any]] = []
    for seed in run_folder.seeds_of(args.run):
        trained = load_run(args.run, seed)
        frontier = find_frontier(getattr(trained.state, "bonus", ()))
        if frontier is None:
            parser.error(f"{args.run} was trained without algorithm.frontier: choose another run")
        last = len(frontier.low) - 1
        if not 0 <= args.feature <= last:
            parser.error(f"FEATURE must be from 0 to {last}, got {args.feature}")
        deviation = round(float(frontier.bonuses.variance) ** 0.5, 4)
        state = {"seed": seed, "env_steps": trained.env_steps, "deviation": deviation}
        rows += [state | share for share in list_shares(frontier, args.feature)]
    write_rows(args.out, about, rows)


if __name__ == "__main__":
    main()
