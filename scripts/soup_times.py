"""When the soups of a trained run are served.

python results/overcooked/soup_times.py RUN OUT

OUT (JSON) gets, for each seed, the steps at which one greedy game per seat earns its soups, and the
player that served each.
"""

import json
import sys
from pathlib import Path

import jax
import numpy as np

from envs_jax.overcooked.rules import SOUP
from hmasd_jax.analysis.render import play
from hmasd_jax.runs import folder as run_folder
from hmasd_jax.runs.load import load_run

GAMES = 16
"""Enough for both seats to be among them."""


def look(run: Path, seed: int) -> dict:
    """One greedy game for each seat that agent 0 can have."""
    trained = load_run(run, seed)
    policy = trained.algorithm.policy(trained.state, True)
    keys = jax.random.split(jax.random.key(0), GAMES)
    states, timesteps, _ = jax.device_get(play(trained.env, policy, keys))
    games = {}
    for player in (0, 1):
        game = int(np.flatnonzero(states.swapped[:, 0] == bool(player))[0])
        steps = np.flatnonzero(timesteps.reward[game])
        carries_soup = states.held[game][steps - 1] > SOUP
        games[f"agent 0 is player {player}"] = {
            "served_at": steps.tolist(),
            "by_player": carries_soup.argmax(1).tolist(),
        }
    return {"seed": seed, "env_steps": trained.env_steps, **games}


def main() -> None:
    """Look at all seeds and write."""
    run, out = map(Path, sys.argv[1:])
    about = run_folder.describe(["python", *sys.argv])
    about["run"] = json.loads((run / "run.json").read_text())
    about["rows"] = [look(run, seed) for seed in run_folder.seeds_of(run)]
    out.write_text(json.dumps(about, indent=1) + "\n")


if __name__ == "__main__":
    main()
