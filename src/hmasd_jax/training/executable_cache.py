"""Compiled programs on disk, so that each is compiled once for all processes and starts.

JAX keeps the programs. On a CPU, a program fits only the type of processor that it was compiled
for, and XLA's own check of the type is not reliable: it objects to programs that this very machine
compiled (JAX issue 38445), and JAX's key leaves the processor out. Here, each type of processor and
version of JAX has a folder of its own. Beside the programs of a run, a digest of what they computed
when they were new is kept. Programs from disk that compute anything else are compiled anew.
"""

import hashlib
import logging
import os
import platform
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import jax
import jaxlib
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

from hmasd_jax.runs.durable import replace
from hmasd_jax.runs.folder import available_cores, exclusive

LOGGER = logging.getLogger(__name__)
T = TypeVar("T")
CPUINFO = Path("/proc/cpuinfo")
FEATURES = ("vendor_id", "cpu family", "model", "model name", "stepping", "flags", "Features")
"""Fields of `CPUINFO` that code for a processor depends on."""


def use_cache() -> str | None:
    """Let JAX keep compiled programs, unless it was told where or not to.

    Returns:
        A line that says why programs cannot be kept, or None if they are.
    """
    told = jax.config.values["jax_compilation_cache_dir"]
    if told is not None or not jax.config.values["jax_enable_compilation_cache"]:
        return None
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hmasd_jax"
    folder = root
    if jax.default_backend() == "cpu":
        processor = describe_processor()
        if processor is None:
            return "programs are compiled at every start: the type of this processor is unknown"
        folder = root / f"cpu-{digest_of([processor.encode()])[:16]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with exclusive(folder / ".writable"):
            pass
    except OSError as error:
        return (
            f"programs are compiled at every start: cannot write {folder} ({error.strerror}); set "
            "JAX_COMPILATION_CACHE_DIR to a folder that can be written"
        )
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    _set("jax_compilation_cache_dir", str(folder))
    return None


def describe_processor() -> str | None:
    """Return what compiled code depends on beside the program; None if it is not known."""
    try:
        first = CPUINFO.read_text().split("\n\n")[0]
    except OSError:
        return None
    fields = dict(line.split(":", 1) for line in first.splitlines() if ":" in line)
    known = {name.strip(): value.strip() for name, value in fields.items()}
    if not {"flags", "Features"} & known.keys():
        return None
    versions = [jax.__version__, jaxlib.__version__, platform.machine()]
    settings = [os.environ.get(name, "") for name in ("XLA_FLAGS", "JAX_XLA_FLAGS")]
    return "\n".join([*versions, *settings, *(known.get(name, "") for name in FEATURES)])


def load_or_compile(
    programs: Sequence[jax.stages.Lowered],
    compile_all: Callable[[], T],
    compute: Callable[[T], Any],
) -> T:
    """Compile programs, or load them if any process has compiled them.

    Of processes that need the same programs, one compiles and the others wait. Programs that have
    been compiled are loaded by all at once. On a CPU, programs from disk are used only if they
    compute what they did when they were compiled.

    Args:
        programs: The programs.
        compile_all: Function that compiles them; JAX takes them from disk if it can.
        compute: Function from the executables to arrays that they compute. It must be repeatable.
    """
    folder = jax.config.values["jax_compilation_cache_dir"]
    in_use = folder is not None and jax.config.values["jax_enable_compilation_cache"]
    if not in_use or jax.default_backend() != "cpu":
        return compile_all()
    texts = [program.as_text().encode() for program in programs]
    fast_to_compile = jax.config.read("jax_disable_most_optimizations")
    setting = f"{describe_processor()} {len(available_cores())} {fast_to_compile}"
    key = digest_of([*texts, setting.encode()])
    record = Path(folder) / f"{key}.sha256"
    executables = None
    try:
        if not record.exists():
            with exclusive(record.with_suffix(".lock")):
                if not record.exists():  # Another process may have written it meanwhile.
                    executables = compile_all()
                    replace(record, _digest_results(compute(executables)).encode())
                    return executables
        expected = record.read_text()
    except OSError as error:  # The folder was deleted, or cannot be written.
        reason = error.strerror or error
        LOGGER.warning("warning: cannot keep programs in %s: %s", folder, reason)
        return compile_all() if executables is None else executables
    executables = compile_all()
    if expected == _digest_results(compute(executables)):
        return executables
    LOGGER.warning(
        "warning: compiling anew, since programs kept in %s computed something else than when "
        "they were compiled; delete it",
        folder,
    )
    with _disabled():
        return compile_all()


def _digest_results(arrays: Any) -> str:
    """Return a digest of what programs have computed."""
    return digest_of(np.asarray(x).tobytes() for x in jax.tree.leaves(arrays))


@contextmanager
def _disabled() -> Iterator[None]:
    """Make JAX compile every program anew."""
    _set("jax_enable_compilation_cache", False)
    jax.clear_caches()
    try:
        yield
    finally:
        _set("jax_enable_compilation_cache", True)


def _set(name: str, value: Any) -> None:
    """Change a setting of JAX's cache, and make the cache read its settings again."""
    jax.config.update(name, value)
    compilation_cache.reset_cache()


def digest_of(parts: Any) -> str:
    """Return a SHA-256 digest of pieces of bytes, in order."""
    total = hashlib.sha256()
    for part in parts:
        total.update(hashlib.sha256(part).digest())
    return total.hexdigest()
