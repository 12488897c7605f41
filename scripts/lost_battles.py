"""Record by how much a trained run wins and loses its battles.

python scripts/lost_battles.py RUN OUT

OUT (JSON) gets one row per seed: the share of greedy battles that are won, the allies alive at the
end of a battle that is won, the share of steps with several shooting allies in which all have the
same target, and the health that all enemies together have left at the end of a battle that is lost.
"""

from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from envs_jax.micro_battle.observations import FIRST_ATTACK
from hmasd_jax.analysis.episodes import play
from hmasd_jax.runs.load import load_run
from scripts.records import record_seeds

BATTLES = 200
PERCENTILES = (0, 10, 50, 90, 100)


def measure(run: Path, seed: int) -> dict[str, Any]:
    """Play greedily, and return how many battles are won and lost, and by how much."""
    trained = load_run(run, seed)
    policy = trained.algorithm.policy(trained.state, True)
    keys = jax.random.split(jax.random.key(0), BATTLES)
    states, timesteps, *_ = jax.device_get(play(trained.env, policy, keys))
    battle, end = np.arange(BATTLES), timesteps.done.argmax(1)
    won = timesteps.info["success"][battle, end] > 0
    health = np.maximum(states.units.health[battle, end], 0.0)
    allies, enemies = np.split(health, [trained.env.num_agents], axis=1)
    in_battle = np.arange(states.time.shape[1]) <= end[:, None]
    row = {
        "seed": seed,
        "env_steps": trained.env_steps,
        "won": float(won.mean()),
        "same target": share_of_same_targets(states.last_action[in_battle]),
    }
    if won.any():
        row["allies left"] = round(float((allies[won] > 0).sum(1).mean()), 2)
    if not won.all():
        shares = np.percentile(enemies[~won].sum(1), PERCENTILES).round(1).tolist()
        row["health left"] = dict(zip(map(str, PERCENTILES), shares))
    return row


def share_of_same_targets(actions: Int[np.ndarray, "steps agents"]) -> float | None:
    """Return in what share of the steps with several attacks all attack the same enemy."""
    attacks = actions >= FIRST_ATTACK
    several = actions[attacks.sum(1) > 1]
    if not len(several):
        return None
    highest = several.max(1, keepdims=True)
    same = ((several == highest) | (several < FIRST_ATTACK)).all(1)
    return round(float(same.mean()), 3)


if __name__ == "__main__":
    record_seeds(__doc__, "folder of a run on micro_battle", measure)
