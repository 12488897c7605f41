"""Record traces of the original Overcooked game.

PYTHONPATH=OVERCOOKED_AI/src python tests/golden/overcooked/record_traces.py

`traces.npz` was recorded with github.com/HumanCompatibleAI/overcooked_ai at commit 739950a (22
March 2025), with numpy, scipy, dill and gymnasium installed. Per layout and rule it holds 12 chains
of 20 steps, each from a random state: the states, actions and rewards, and both players'
observations after every step.
"""

from pathlib import Path

import numpy as np

from envs_jax.overcooked.layouts import LAYOUTS
from tests.golden.overcooked.oracle import (
    Oracle,
    cooking_action,
    random_action,
    random_state,
)

CHAINS, LENGTH = 12, 20
KEPT = ("pose", "held", "grid", "time")
"""Fields of `OvercookedState` that are recorded before and after each step."""


def record(layout: str, start_cooking: str, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return arrays of integers (CHAINS * LENGTH, ...) for one layout and rule."""
    oracle = Oracle("overcooked_ai_py", layout, start_cooking)
    steps = []
    for chain in range(CHAINS):
        theirs = oracle.theirs(random_state(rng, layout))
        for _ in range(LENGTH):
            before = oracle.ours(theirs)
            cooks = chain % 2
            action = cooking_action(rng, oracle.features(theirs)) if cooks else random_action(rng)
            theirs, reward = oracle.step(theirs, action)
            after = oracle.ours(theirs)
            steps.append(
                {
                    **{f"before_{name}": getattr(before, name) for name in KEPT},
                    **{f"after_{name}": getattr(after, name) for name in KEPT},
                    "action": action,
                    "reward": np.array(reward),
                    "features": oracle.features(theirs),
                    "lossless": oracle.lossless(theirs),
                }
            )
    arrays = {name: np.stack([step[name] for step in steps]) for name in steps[0]}
    small = {name: array.astype(np.int16) for name, array in arrays.items()}
    assert all((small[name] == arrays[name]).all() for name in arrays)
    return small


def main() -> None:
    """Write traces.npz next to this file."""
    rng = np.random.default_rng(0)
    traces = {
        f"{layout}/{start_cooking}/{name}": array
        for layout in LAYOUTS
        for start_cooking in ("interact", "auto")
        for name, array in record(layout, start_cooking, rng).items()
    }
    np.savez_compressed(Path(__file__).with_name("traces.npz"), **traces)


if __name__ == "__main__":
    main()
