"""How often the scripted players of tests/envs/battle_tactics.py win.

python results/micro_battle/tactics.py

Writes tactics.json beside this file: what made it, and one row per scenario, balance, tactic, share
of random actions and distance up to which units start off their places.
"""

import json
import runpy
from pathlib import Path

import numpy as np

from envs_jax.micro_battle import environment as micro_battle
from hmasd_jax.runs import folder as run_folder

EPISODES = 4000
TESTS = Path(__file__).parents[2] / "tests" / "envs"
TACTICS = runpy.run_path(str(TESTS / "battle_tactics.py"))
LISTED = runpy.run_path(str(TESTS / "test_micro_battle_tactics.py"))["WIN_RATES"]
STARTS = [
    ("3m", "multi", tactic, 0.0, jitter)
    for tactic in ("advance, first", "hold, random target")
    for jitter in (0.05, 0.0)
]
HIDING = [
    ("3m", "multi", "hide in the corner", 0.0),
    ("2s_vs_1sc", "multi", "hide in the corner", 0.0),
    ("2m_vs_1z", "multi", "hide at the bottom", 0.0),
]


def main() -> None:
    """Play, print and write."""
    usual = micro_battle.JITTER
    rows = []
    for scenario, balance, tactic, noise, jitter in [
        *((*row[:4], usual) for row in (*LISTED, *HIDING)),
        *STARTS,
    ]:
        micro_battle.JITTER = jitter
        micro_battle._copies_last.cache_clear()  # compiled with the other distance
        play = TACTICS["make_play"](micro_battle.MicroBattle(scenario, balance), EPISODES)
        won, late, *_ = play(tactic, noise, seed=0)
        rows.append(
            {
                "scenario": scenario,
                "balance": balance,
                "tactic": tactic,
                "random_actions": noise,
                "start_distance": jitter,
                "episodes": EPISODES,
                "wins": float(np.mean(won)),
                "out_of_time": float(np.mean(late)),
            }
        )
        print(rows[-1], flush=True)
    about = run_folder.describe(["python", "results/micro_battle/tactics.py"])
    out = Path(__file__).with_name("tactics.json")
    out.write_text(json.dumps(about | {"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
