"""Record by how much a trained run loses its battles.

python scripts/lost_battles.py RUN OUT

OUT (JSON) gets one row per seed: the share of greedy battles that are won, and the health that all
enemies together have left at the end of those that are lost.
"""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from hmasd_jax.analysis.episodes import play
from hmasd_jax.runs.load import load_run
from scripts.records import record_seeds

BATTLES = 200
PERCENTILES = (0, 10, 50, 90, 100)


def measure(run: Path, seed: int) -> dict[str, Any]:
    """Play greedily, and return how many battles are won and how close the lost ones are."""
    trained = load_run(run, seed)
    policy = trained.algorithm.policy(trained.state, True)
    keys = jax.random.split(jax.random.key(0), BATTLES)
    states, timesteps, *_ = jax.device_get(play(trained.env, policy, keys))
    battle, end = np.arange(BATTLES), timesteps.done.argmax(1)
    won = timesteps.info["success"][battle, end] > 0
    health = states.units.health[battle, end][:, trained.env.num_agents :]
    left = np.maximum(health, 0.0).sum(1)[~won]
    row = {"seed": seed, "env_steps": trained.env_steps, "won": float(won.mean())}
    if len(left):
        shares = np.percentile(left, PERCENTILES).round(1).tolist()
        row["health left"] = dict(zip(map(str, PERCENTILES), shares))
    return row


if __name__ == "__main__":
    record_seeds(__doc__, "folder of a run on micro_battle", measure)
