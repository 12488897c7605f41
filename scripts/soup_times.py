"""Record when a trained run serves its soups.

python scripts/soup_times.py RUN OUT

OUT (JSON) gets one row per seed: for each seat of agent 0, the steps at which one greedy game
earns its soups, the player that served each, the number of soups taken from each pot, and the
number of steps after which both players hold an onion.
"""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from envs_jax.overcooked.rules import COOKING, NOTHING, ONION, POT, SOUP
from hmasd_jax.analysis.episodes import play
from hmasd_jax.runs.load import load_run
from scripts.records import record_seeds

GAMES = 16
"""Games to play; enough for both seats to be among them."""


def measure(run: Path, seed: int) -> dict[str, Any]:
    """Play greedily, and return the soups of one game for each seat that agent 0 can have."""
    trained = load_run(run, seed)
    policy = trained.algorithm.policy(trained.state, True)
    keys = jax.random.split(jax.random.key(0), GAMES)
    states, timesteps, *_ = jax.device_get(play(trained.env, policy, keys))
    games = {}
    for player in (0, 1):
        game = int(np.flatnonzero(states.swapped[:, 0] == bool(player))[0])
        steps = np.flatnonzero(timesteps.reward[game])
        # The one who serves has empty hands afterwards.
        serves = (states.held[game][steps - 1] > SOUP) & (states.held[game][steps] == NOTHING)
        games[f"agent 0 is player {player}"] = {
            "served_at": steps.tolist(),
            "by_player": serves.argmax(1).tolist(),
            "from_pot": soups_from(states.grid[game]),
            "two_onions": int((states.held[game] == ONION).all(1).sum()),
        }
    return {"seed": seed, "env_steps": trained.env_steps, **games}


def soups_from(grid: np.ndarray) -> dict[str, int]:
    """Count the soups taken from each pot of a game, (T, cells), by the number of its cell."""
    taken = (grid[:-1] >= COOKING) & (grid[1:] == POT)
    return {str(cell): int(taken[:, cell].sum()) for cell in np.flatnonzero(grid[0] == POT)}


if __name__ == "__main__":
    record_seeds(__doc__, "folder of a run on overcooked", measure)
