"""The next command to type, told at the end of each command."""

import shlex
import sys


def suggest_next(*words: object) -> None:
    """Print a command on stderr, so that stdout stays what scripts read."""
    command = shlex.join(["python", "-m", "hmasd_jax.train", *map(str, words)])
    print(f"next: {command}", file=sys.stderr)
