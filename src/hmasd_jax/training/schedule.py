"""What follows from a configuration: counts of updates, and when to log, evaluate and save."""

from dataclasses import dataclass

from hmasd_jax.config import TrainConfig


@dataclass(frozen=True)
class Plan:
    """A run in units of updates. Evaluations and checkpoints fall on multiples of `log_every`."""

    env_steps_per_update: int
    num_updates: int
    log_every: int
    eval_every: int
    checkpoint_every: int

    @property
    def env_steps(self) -> int:
        """Environment steps of the whole run."""
        return self.num_updates * self.env_steps_per_update

    @property
    def num_evaluations(self) -> int:
        """Evaluations of the whole run, the ones at step 0 and at the end included."""
        return 1 + -(-self.num_updates // self.eval_every)

    def next_stop(self, updates: int) -> int:
        """The update after `updates` at which the host has something to do."""
        return min((updates // self.log_every + 1) * self.log_every, self.num_updates)

    def is_due(self, every: int, updates: int) -> bool:
        """Whether something that happens every so many updates and at the end happens now."""
        return updates % every == 0 or updates == self.num_updates


def make_plan(config: TrainConfig) -> Plan:
    """Round the intervals of `config` (environment steps) to updates.

    The evaluation interval is kept as exactly as whole updates allow. The interval of logging is
    its largest divisor that is not longer than asked for, so that each line of metrics is pooled
    over whole stretches between two stops, wherever a run is interrupted and resumed.
    """
    per_update = config.env_steps_per_update
    eval_every = max(1, round(config.eval_interval / per_update))
    wanted = max(1, round(config.log_interval / per_update))
    log_every = max(d for d in range(1, wanted + 1) if eval_every % d == 0)
    saves = max(1, round(config.checkpoint_interval / per_update / log_every))
    return Plan(
        env_steps_per_update=per_update,
        num_updates=config.total_env_steps // per_update,
        log_every=log_every,
        eval_every=eval_every,
        checkpoint_every=saves * log_every,
    )
