"""Record how well trained teams play that sample, beside the same teams that act greedily.

python scripts/sampled_play.py RUN OUT

OUT (JSON) gets one row per seed: the share of episodes with success, or the mean return where the
environment has no success, played greedily, and played with sampled skills and actions. Both use
the parameters that evaluation uses.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import jax
from jaxtyping import Array, Float

from hmasd_jax.analysis.learning import main_metric
from hmasd_jax.config import build
from hmasd_jax.rl.evaluate import evaluate
from hmasd_jax.runs.folder import read_config
from hmasd_jax.runs.load import load_run
from hmasd_jax.types import Key
from scripts.records import record_seeds

EPISODES = 1000


@cache
def compile_score(run: Path, greedy: bool) -> Callable[[Any, Key], Float[Array, ""]]:
    """Return a jitted function of a train state and a key, for all seeds of a run."""
    env, algorithm = build(read_config(run))

    @jax.jit
    def score(state: Any, key: Key) -> Float[Array, ""]:
        policy = algorithm.policy(state, greedy=greedy)
        metrics = evaluate(env, policy, key, EPISODES)
        return metrics[main_metric(metrics)]

    return score


def measure(run: Path, seed: int) -> dict[str, Any]:
    """Return the score of both ways to play."""
    trained = load_run(run, seed)
    row: dict[str, Any] = {"seed": seed, "env_steps": trained.env_steps}
    for name, greedy in (("greedy", True), ("sampled", False)):
        row[name] = round(float(compile_score(run, greedy)(trained.state, jax.random.key(0))), 4)
    return row


if __name__ == "__main__":
    record_seeds(__doc__, "folder of a run", measure)
