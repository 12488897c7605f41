"""Output of the commands that train, which outlive whoever reads it."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO


class LastingStream:
    """A text stream that drops what it cannot write.

    After Ctrl-C in `train | tee log` nobody reads the pipe, and after the end of a connection the
    terminal is gone. Training must save its state nevertheless.
    """

    def __init__(self, stream: TextIO) -> None:
        """Write to `stream` as long as that works."""
        self._stream = stream

    def write(self, text: str) -> int:
        """Write a text, or drop it, and return its length."""
        try:
            self._stream.write(text)
        except OSError:
            self._give_up()
        return len(text)

    def flush(self) -> None:
        """Write what is buffered, or drop it."""
        try:
            self._stream.flush()
        except OSError:
            self._give_up()

    def _give_up(self) -> None:
        """Send everything to nothing from now on, also what the interpreter flushes at its end."""
        with suppress(OSError):  # A stream in memory has no file.
            target = self._stream.fileno()
            nothing = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nothing, target)
            os.close(nothing)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def lasting_streams() -> Iterator[None]:
    """Make output that cannot be written no reason for this process to end."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = lasting = tuple(map(LastingStream, before))
    try:
        yield
    finally:
        for stream in lasting:
            stream.flush()
        sys.stdout, sys.stderr = before
