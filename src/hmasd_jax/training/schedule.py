"""Schedule of a run in updates: its length, and the intervals of logs and checkpoints."""

import math
from dataclasses import dataclass

from hmasd_jax.config import TrainConfig

LONGEST = 2**30
"""Most updates between evaluations. It has many divisors, which the log interval may be."""


@dataclass(frozen=True)
class Plan:
    """Length and intervals of a run in updates.

    Evaluations and checkpoints fall on multiples of `log_every`.
    """

    env_steps_per_update: int
    """Environment steps per update."""
    num_updates: int
    """Updates of the whole run."""
    log_every: int
    """Updates between records of training metrics."""
    eval_every: int
    """Updates between evaluations."""
    checkpoint_every: int
    """Updates between checkpoints."""

    @property
    def env_steps(self) -> int:
        """Environment steps of the whole run."""
        return self.num_updates * self.env_steps_per_update

    @property
    def num_evaluations(self) -> int:
        """Evaluations of the whole run, including those at step 0 and at the end."""
        return 1 + -(-self.num_updates // self.eval_every)

    def next_stop(self, updates: int) -> int:
        """Return the first update after `updates` at which the host logs metrics."""
        return min((updates // self.log_every + 1) * self.log_every, self.num_updates)

    def is_due(self, every: int, updates: int) -> bool:
        """Return True if `updates` is a multiple of `every` or the end of the run."""
        return updates % every == 0 or updates == self.num_updates


def make_plan(config: TrainConfig) -> Plan:
    """Convert the intervals of `config` from environment steps to updates.

    The evaluation interval is rounded to whole updates. The log interval is the largest divisor of
    it that is not longer than the one in `config`. Each record of metrics then covers the same
    updates, wherever a run is interrupted and resumed.
    """
    per_update = config.env_steps_per_update
    eval_every = min(max(1, round(config.eval_interval / per_update)), LONGEST)
    wanted = max(1, round(config.log_interval / per_update))
    log_every = max(d for d in divisors(eval_every) if d <= wanted)
    saves = max(1, round(config.checkpoint_interval / per_update / log_every))
    return Plan(
        env_steps_per_update=per_update,
        num_updates=config.total_env_steps // per_update,
        log_every=log_every,
        eval_every=eval_every,
        checkpoint_every=saves * log_every,
    )


def divisors(number: int) -> set[int]:
    """Return all divisors of a number of at least 1."""
    small = [d for d in range(1, math.isqrt(number) + 1) if number % d == 0]
    return {*small, *(number // d for d in small)}
