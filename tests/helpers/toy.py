"""A toy algorithm that compiles in a second, to test the host side of training.

As a script it runs the command line with the toy algorithm registered, also in worker processes.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hmasd_jax.algorithms import ALGORITHMS, AlgorithmEntry
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.runs import metrics_log
from hmasd_jax.runs.folder import metrics_path
from hmasd_jax.types import Algorithm, Learner, Policy


@dataclass(frozen=True)
class ToyConfig:
    """Settings of the toy, whose parameter walks at random."""

    scale: float = 1.0
    """Standard deviation of a step of the walk."""
    explode_at: int = -1
    """Update at which the parameters of about half of the seeds become NaN; -1 is never."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Settings that give the number of environment steps per update."""


class ToyState(NamedTuple):
    """Train state of the toy."""

    key: jax.Array
    num_updates: jax.Array
    fragile: jax.Array
    """True if the seed fails at `explode_at`."""
    learner: Learner


def make_toy(env: Any, config: ToyConfig) -> Algorithm:
    """Return a random walk whose policy acts at random, with odds that depend on the parameter."""

    def init(key):
        key, key_fragile = jax.random.split(key)
        fragile = jax.random.bernoulli(key_fragile)
        return ToyState(key, jnp.int32(0), fragile, Learner({"w": jnp.zeros(3)}, ()))

    def update(state):
        key, key_step = jax.random.split(state.key)
        w = state.learner.params["w"] + config.scale * jax.random.normal(key_step, (3,))
        count = state.num_updates + 1
        w = jnp.where(state.fragile & (count == config.explode_at), jnp.nan, w)
        metrics = {
            "episodes": jnp.float32(count % 3),
            "episode_sum/success": jnp.float32(count % 3 == 2),
            "loss": w.mean(),
        }
        return ToyState(key, count, state.fragile, Learner({"w": w}, ())), metrics

    def policy(state, greedy=True):
        def step(memory, timestep, first, key):
            batch = timestep.obs.shape[:-1]
            logit = jax.random.normal(key, batch) + state.learner.params["w"].sum()
            return memory, (logit > 0).astype(jnp.int32), ()

        return Policy(lambda batch_shape: (), step)

    return Algorithm(init, update, policy)


# 10 updates of 20 environment steps each. Metrics are logged every 2 updates; evaluations and
# checkpoints follow every 4.
SETTINGS = {
    "algorithm.name": "toy",
    "algorithm.ppo.num_envs": 2,
    "algorithm.ppo.rollout_length": 10,
    "env.max_steps": 4,
    "total_env_steps": 200,
    "log_interval": 40,
    "eval_interval": 80,
    "checkpoint_interval": 80,
    "eval_episodes": 5,
    "num_seeds": 3,
}
CLOCKS = ("wall_seconds", "env_steps_per_second")


def words(**more: Any) -> list[str]:
    """Return `SETTINGS` and changes to them as a command line; `__` in a name stands for a dot."""
    settings = SETTINGS | {name.replace("__", "."): value for name, value in more.items()}
    return [str(x) for name, value in settings.items() for x in (f"--{name}", value)]


def numbers(run: Path, seed: int) -> list[dict[str, Any]]:
    """Return all records of a seed, without entries that depend on the clock."""
    records = metrics_log.read(metrics_path(run, seed))
    return [{k: v for k, v in record.items() if k not in CLOCKS} for record in records]


ALGORITHMS.setdefault("toy", AlgorithmEntry(ToyConfig, make_toy))

if __name__ == "__main__":
    from hmasd_jax.cli.main import main

    sys.exit(main())
