"""Trials of a search: which one to train next, when to stop it, and how it has ended.

A process holds a lock file for the trial that it trains. A trial that still counts as running but
is not locked was interrupted or killed: the next process continues it from its checkpoints.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from hmasd_jax.runs.folder import LOCK, exclusive, hold, seed_lock, seeds_of
from hmasd_jax.search.score import read_evaluations, scores_so_far
from hmasd_jax.search.study import Search, trial_folder
from hmasd_jax.training.job import Event
from hmasd_jax.training.schedule import make_plan

if TYPE_CHECKING:
    from optuna import Trial
    from optuna.trial import FrozenTrial

PLACE = "place"
"""Attribute of a trial: the folder that has its run, among those of several machines."""
REASON = "reason"
"""Attribute of a failed trial."""
REPEATS = "repeats"
"""Attribute of a trial with the values of an earlier one, whose score it takes: its number."""


@contextmanager
def next_trial(search: Search) -> Iterator["Trial | None"]:
    """Yield the next trial to train, locked for this process; None if there is none.

    Interrupted trials come first.
    """
    with ExitStack() as locks:
        with exclusive(search.folder / LOCK):
            trial = _continue(search, locks) or _begin(search, locks)
        if trial is not None:
            run = trial_folder(search.folder, trial.number)
            for seed in seeds_of(run):  # Workers of a killed process save before they end.
                with exclusive(seed_lock(run, seed)):
                    pass
        yield trial


def _continue(search: Search, locks: ExitStack) -> "Trial | None":
    """Lock and return a trial that no process trains, although it has not ended."""
    import optuna

    unplaced = search.place if search.is_local else None  # Killed before its place was noted.
    for frozen in _running(search):
        if frozen.user_attrs.get(PLACE, unplaced) != search.place:
            continue
        with ExitStack() as lock:
            # Only a trial that is locked stays as it is: another process may have ended it since.
            if _lock(search, frozen.number, lock) and _is_running(search, frozen.number):
                locks.enter_context(lock.pop_all())
                return optuna.Trial(search.study, frozen._trial_id)
    return None


def _running(search: Search) -> "list[FrozenTrial]":
    """Return the trials that have begun and of which nobody has told how they ended."""
    import optuna

    return search.study.get_trials(deepcopy=False, states=[optuna.trial.TrialState.RUNNING])


def _is_running(search: Search, number: int) -> bool:
    return number in [trial.number for trial in _running(search)]


def _begin(search: Search, locks: ExitStack) -> "Trial | None":
    """Lock and return a new trial, unless there are enough."""
    import optuna

    trials = search.study.get_trials(deepcopy=False)
    waiting = optuna.trial.TrialState.WAITING
    if sum(trial.state != waiting for trial in trials) >= search.trials:
        return None
    trial = search.study.ask()
    trial.set_user_attr(PLACE, search.place)
    return trial if _lock(search, trial.number, locks) else None


def _lock(search: Search, number: int, locks: ExitStack) -> bool:
    return locks.enter_context(hold(search.folder / f".trial_{number}.lock"))


def find_twin(search: Search, trial: "Trial") -> "FrozenTrial | None":
    """Return an earlier trial that has ended with the same values, hence with the same run."""
    import optuna

    states = [optuna.trial.TrialState.COMPLETE, optuna.trial.TrialState.PRUNED]
    ended = search.study.get_trials(deepcopy=False, states=states)
    twins = (t for t in ended if t.params == trial.params and t.number < trial.number)
    return next(twins, None) if trial.params else None


class Pruner:
    """A watcher that reports the evaluations of a trial, and stops it if it falls behind.

    The preset is never stopped.
    """

    def __init__(self, search: Search, trial: "Trial", config: Any, at_once: int) -> None:
        """Prepare to follow a trial.

        Args:
            search: The search.
            trial: The trial.
            config: Its configuration.
            at_once: Number of its seeds that train at once.
        """
        self._trial, self._config = trial, config
        self._run = trial_folder(search.folder, trial.number)
        self._at_once, self._last = at_once, search.definition.last
        self._total = make_plan(config).num_evaluations - 1
        self._reported = _reported(search, trial.number)
        self.pruned = False

    def handle(self, event: Event) -> None:
        """Report new scores to Optuna after an evaluation."""
        if event.kind != "eval" or self.pruned:
            return
        for number, score in self._scores():
            if number in self._reported:
                continue
            self._trial.report(score, number)
            self._reported.add(number)
            is_end = number == self._groups * self._total
            if self._trial.number and not is_end and self._trial.should_prune():
                self.pruned = True
                return

    def should_stop(self) -> bool:
        """Return True if the trial has fallen behind."""
        return self.pruned

    def score(self) -> float:
        """Return the score of a trial that is trained to its end."""
        return list(self._scores())[-1][1]

    @property
    def _groups(self) -> int:
        return -(-self._config.num_seeds // self._at_once)

    def _scores(self) -> Iterator[tuple[int, float]]:
        _, evaluations = read_evaluations(self._run, self._config.num_seeds)
        return scores_so_far(evaluations, self._at_once, self._total, self._last)


def _reported(search: Search, number: int) -> set[int]:
    """Return the numbers of evaluations that an earlier process has reported."""
    trials = search.study.get_trials(deepcopy=False)
    return set(next(t for t in trials if t.number == number).intermediate_values)


def complete(search: Search, trial: "Trial", score: float) -> None:
    """Record the score of a trial that is trained to its end."""
    search.study.tell(trial.number, score)


def prune(search: Search, trial: "Trial") -> None:
    """Record that a trial was stopped; its last score is its value."""
    import optuna

    search.study.tell(trial.number, state=optuna.trial.TrialState.PRUNED)


def fail(search: Search, trial: "Trial", reason: str) -> None:
    """Record that a trial has no score."""
    import optuna

    trial.set_user_attr(REASON, reason)
    search.study.tell(trial.number, state=optuna.trial.TrialState.FAIL)


def repeat(search: Search, trial: "Trial", twin: "FrozenTrial") -> None:
    """Record the end of an earlier trial with the same values as that of a new one."""
    trial.set_user_attr(REPEATS, twin.number)
    for number, score in sorted(twin.intermediate_values.items()):
        trial.report(score, number)
    search.study.tell(trial.number, twin.value if twin.state.name == "COMPLETE" else None,
                      state=twin.state)  # fmt: skip


def best(search: Search) -> "FrozenTrial | None":
    """Return the complete trial with the highest score, the earliest of equal ones."""
    import optuna

    done = search.study.get_trials(states=[optuna.trial.TrialState.COMPLETE])
    return max(done, key=lambda trial: (trial.value, -trial.number), default=None)
