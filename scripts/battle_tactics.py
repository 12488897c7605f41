"""Count how often hand-written tactics win battles of `micro_battle`.

python scripts/battle_tactics.py [--out results/micro_battle/tactics.json]

Plays `BATTLES` with the players in `scripts.tactics`, and writes one row for each.
"""

import argparse
import dataclasses
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from envs_jax.micro_battle import SCENARIOS, MicroBattle
from envs_jax.micro_battle.unit_types import Balance
from scripts.records import RESULTS, describe_script, write_rows
from scripts.tactics import make_play

EPISODES = 4000
"""Episodes of each recorded battle."""


class Battle(NamedTuple):
    """A tactic on a scenario, as it is recorded."""

    scenario: str
    balance: Balance
    tactic: str
    random_actions: float = 0.0
    """Probability that an action is replaced by a random legal one."""
    jitter: float | None = None
    """`Scenario.jitter` to play with; None is the scenario's own."""


BATTLES = [
    Battle(scenario, balance, tactic, share)
    for scenario, balance, tactic, *shares in (
        ("3m", "multi", "random", 0.0),
        ("3m", "multi", "attack else random", 0.0),
        ("3m", "multi", "walk, nearest", 0.0),
        ("3m", "multi", "hold, nearest", 0.0),
        ("3m", "multi", "hold, random target", 0.0),
        ("3m", "multi", "hold, weakest", 0.0),
        ("3m", "multi", "advance, first", 0.0, 0.1),
        ("3m", "multi", "advance, middle first", 0.0, 0.1),
        ("2m_vs_1z", "multi", "random", 0.0),
        ("2m_vs_1z", "multi", "walk, nearest", 0.0),
        ("2m_vs_1z", "multi", "hold, nearest", 0.0),
        ("2m_vs_1z", "multi", "attack else random", 0.0),
        ("2m_vs_1z", "multi", "alternate", 0.0, 0.1, 0.3),
        ("2s_vs_1sc", "multi", "random", 0.0),
        ("2s_vs_1sc", "multi", "attack else random", 0.0),
        ("2s_vs_1sc", "multi", "walk, nearest", 0.0),
        ("2s_vs_1sc", "multi", "swap", 0.0),
        ("2s_vs_1sc", "multi", "swap and rest", 0.0, 0.1),
        ("2s_vs_1sc", "liberty", "swap", 0.0),
        ("2s_vs_1sc", "liberty", "swap and rest", 0.0, 0.1),
        ("3m", "multi", "hide in the corner", 0.0),
        ("2s_vs_1sc", "multi", "hide in the corner", 0.0),
        ("2m_vs_1z", "multi", "hide at the bottom", 0.0),
    )
    for share in shares
] + [
    Battle("3m", "multi", tactic, jitter=jitter)
    for tactic in ("advance, first", "hold, random target")
    for jitter in (0.05, 0.0)
]
"""Battles in results/micro_battle/tactics.json, in its order."""


@lru_cache
def make_player(scenario: str, balance: Balance, jitter: float):
    """Compile `make_play` once for all tactics on a scenario."""
    battle = dataclasses.replace(SCENARIOS[scenario], jitter=jitter)
    return make_play(MicroBattle(battle, balance), EPISODES)


def measure(battle: Battle) -> dict[str, Any]:
    """Play `EPISODES` episodes and return the row of the record."""
    jitter = battle.jitter
    if jitter is None:
        jitter = SCENARIOS[battle.scenario].jitter
    play = make_player(battle.scenario, battle.balance, jitter)
    won, late, *_ = play(battle.tactic, battle.random_actions)
    return {
        **battle._asdict(),
        "jitter": jitter,
        "episodes": EPISODES,
        "wins": float(np.asarray(won).mean()),
        "out_of_time": float(np.asarray(late).mean()),
    }


def main() -> None:
    """Play all battles and write the record."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=RESULTS / "micro_battle" / "tactics.json")
    args = parser.parse_args()
    about = describe_script()
    rows = []
    for battle in BATTLES:
        rows.append(measure(battle))
        print(rows[-1], flush=True)
    write_rows(args.out, about, rows)


if __name__ == "__main__":
    main()
