"""Settings that must stand before jax is imported: tests are bound by compile time."""

import atexit
import functools
import gc
import os
import shutil
import sys
import tempfile
from importlib.metadata import version

from hypothesis import settings

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # See `hmasd_jax.cli.main`.
# The older code generator compiles in a third of the time, and each worker of pytest has one core,
# which gains nothing from code that is split to be compiled in parallel.
FLAGS = "--xla_cpu_parallel_codegen_split_count=1"
if tuple(map(int, version("jaxlib").split(".")[:3])) < (0, 11, 1):  # which removed it
    FLAGS += " --xla_cpu_use_fusion_emitters=false"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FLAGS}".strip()
# Commands that are told to be typed next then begin with `python`, in any shell.
os.environ["PATH"] = os.pathsep.join([os.path.dirname(sys.executable), os.environ.get("PATH", "")])
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    # A program is compiled once for all tests, for all workers of pytest and for what they start.
    programs = tempfile.mkdtemp(prefix="hmasd_jax_tests_")
    atexit.register(shutil.rmtree, programs, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = programs
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"

from jax._src.interpreters import mlir  # noqa: E402 (the settings above come first)

# JAX makes an MLIR context for each of thousands of programs. One for all saves a twentieth of the
# time.
mlir.make_ir_context = functools.cache(mlir.make_ir_context)

gc.set_threshold(50_000)  # Tracing makes many objects; looking for garbage takes a fifth of it.

settings.register_profile("default", deadline=None, max_examples=60)
settings.register_profile("long", deadline=None, max_examples=5000)
settings.load_profile("default")
