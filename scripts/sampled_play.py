"""Record how much worse a trained run plays when it samples.

python scripts/sampled_play.py RUN OUT

OUT (JSON) gets one row per seed: means over episodes in which skills and actions are the most
likely ones (`greedy`), and over episodes in which they are drawn (`sampled`). Both play with the
parameters that act in evaluation. Training metrics also tell of play that samples, but with the
parameters of the last gradient step.
"""

from pathlib import Path
from typing import Any

import jax

from envs_jax import Environment
from hmasd_jax.rl.evaluate import evaluate
from hmasd_jax.runs.load import load_run
from hmasd_jax.types import Algorithm, Key
from scripts.records import record_seeds

EPISODES = 1000


def measure(run: Path, seed: int) -> dict[str, Any]:
    """Play greedily and sampled, and return the means of both."""
    trained = load_run(run, seed)
    means = compare_play(
        trained.env, trained.algorithm, trained.state, jax.random.key(seed), EPISODES
    )
    return {"seed": seed, "env_steps": trained.env_steps, "episodes": EPISODES, **means}


def compare_play(
    env: Environment, algorithm: Algorithm, state: Any, key: Key, episodes: int
) -> dict[str, dict[str, float]]:
    """Return the metrics of `greedy` and of `sampled` episodes, from the same resets."""
    means = {}
    for name in ("greedy", "sampled"):
        policy = algorithm.policy(state, name == "greedy")
        metrics = jax.jit(lambda key, policy=policy: evaluate(env, policy, key, episodes))(key)
        means[name] = {metric: round(float(mean), 4) for metric, mean in metrics.items()}
    return means


if __name__ == "__main__":
    record_seeds(__doc__, "folder of a run", measure)
