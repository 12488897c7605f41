"""The next command to type, told at the end of each command."""

import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

COMMANDS = (
    "train", "seed_sweep", "grid", "tune", "evaluate", "render", "plot", "compare", "report",
)  # fmt: skip
"""Names of all commands."""


def suggest_next(*words: object) -> None:
    """Print a command on stderr, so that stdout stays what scripts read."""
    print(f"next: {write_command(*words)}", file=sys.stderr)


def write_command(*words: object) -> str:
    """Return the text to type in this shell to start this command line with `words`."""
    return shlex.join([_python(), *shell_command(*words)[1:]])


def _python() -> str:
    """Return how this shell starts the Python that is running.

    Without an active environment `python` is another one, or none.
    """
    running = Path(sys.executable)
    found = shutil.which("python")
    if found is not None and Path(found).absolute().parent == running.parent:
        return "python"
    return str(running.relative_to(Path.cwd()) if Path.cwd() in running.parents else running)


def shell_command(*words: object) -> list[str]:
    """Return the words of the command that starts this command line with `words`.

    A script that registers environments and calls `main` is a command line of its own.
    """
    main: Any = sys.modules["__main__"]
    is_script = main.__spec__ is None and str(getattr(main, "__file__", "")).endswith(".py")
    start = ["-m", "hmasd_jax.train"]
    if is_script and sys.argv[1:2] and sys.argv[1] in COMMANDS:
        start = sys.argv[:1]
    return ["python", *start, *map(str, words)]
