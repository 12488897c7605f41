"""Signals that stop a run, which then saves what it has trained."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any


def stopping_signals() -> tuple[signal.Signals, ...]:
    """Return the signals that stop a run: SIGINT, SIGTERM and SIGHUP.

    The end of a terminal or of a connection sends SIGHUP. It is left out where it is ignored, as
    under `nohup`, because the run is then meant to go on.
    """
    found = [signal.SIGINT, signal.SIGTERM]
    hangup = getattr(signal, "SIGHUP", None)  # Windows has none.
    if hangup is not None and signal.getsignal(hangup) != signal.SIG_IGN:
        found.append(hangup)
    return tuple(found)


class Received:
    """A signal handler that remembers whether a signal has arrived."""

    def __init__(self) -> None:
        """Remember none."""
        self._any = False

    def __call__(self, number: int, frame: Any) -> None:
        """Remember a signal."""
        self._any = True

    def tell(self) -> bool:
        """Return True if a signal has arrived."""
        return self._any


@contextmanager
def stop_on_signal() -> Iterator[Callable[[], bool]]:
    """Catch the signals that stop a run, and yield a function that tells whether one has arrived.

    Training calls it between chunks, so that it can save before it stops. Within another
    `stop_on_signal`, as a sweep within a grid, both learn of the same signals: one that comes when
    the inner training is about to end must still end the outer loop.
    """
    outer = signal.getsignal(signal.SIGTERM)
    if isinstance(outer, Received):
        yield outer.tell
        return
    received = Received()
    previous = {number: signal.signal(number, received) for number in stopping_signals()}
    try:
        yield received.tell
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def hold_signals() -> Iterator[None]:
    """Hold the signals that stop a run, in processes started meanwhile until `take_signals`.

    A worker takes seconds to import JAX, and a signal would end it with a traceback meanwhile.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # It would start with the worker, and release the signals.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, stopping_signals())
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def take_signals() -> Callable[[], bool]:
    """Ignore SIGINT, which the parent handles, and return a function that tells of the others.

    A scheduler sends SIGTERM to all processes at once, or to any of them.
    """
    held, received = stopping_signals(), Received()
    for number in held:
        signal.signal(number, signal.SIG_IGN if number == signal.SIGINT else received)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, held)
    return received.tell
