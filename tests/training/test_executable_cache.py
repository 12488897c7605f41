"""Programs on disk: where they are kept, and that one which computes something else is not used."""

import shutil
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from hmasd_jax import config as configs
from hmasd_jax.runs.folder import hold
from hmasd_jax.training import executable_cache
from hmasd_jax.training.compiled import compile_programs
from hmasd_jax.training.executable_cache import describe_processor, load_or_compile, use_cache
from tests.helpers.toy import SETTINGS

CPUINFO = """processor : 0
vendor_id : AuthenticAMD
model : 17
cpu MHz : {mhz}
flags : fpu sse {flag}

processor : 1
flags : other
"""


@pytest.fixture
def cpuinfo(tmp_path, monkeypatch):
    """`cpuinfo(flag, mhz)`: make the processor have these."""

    def write(flag, mhz):
        (tmp_path / "cpuinfo").write_text(CPUINFO.format(flag=flag, mhz=mhz))
        monkeypatch.setattr(executable_cache, "CPUINFO", tmp_path / "cpuinfo")

    return write


@pytest.fixture
def folder(tmp_path):
    """An empty cache in use, and afterwards the one before."""
    before = jax.config.jax_compilation_cache_dir
    executable_cache._set("jax_compilation_cache_dir", str(tmp_path / "cache"))
    (tmp_path / "cache").mkdir()
    yield tmp_path / "cache"
    executable_cache._set("jax_compilation_cache_dir", before)


@pytest.fixture
def untold(folder, tmp_path, monkeypatch):
    """Nothing says where to keep programs, and the home is an empty folder."""
    executable_cache._set("jax_compilation_cache_dir", None)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    return tmp_path / "home" / ".cache" / "hmasd_jax"


def in_use():
    return Path(jax.config.jax_compilation_cache_dir or "none")


def test_each_type_of_processor_has_a_folder(untold, cpuinfo, monkeypatch):
    folders = []
    for flag, mhz, version in (
        ("avx2", 1, "1"),
        ("avx2", 2, "1"),
        ("avx512f", 1, "1"),
        ("avx2", 1, "2"),
    ):
        executable_cache._set("jax_compilation_cache_dir", None)
        cpuinfo(flag, mhz)
        monkeypatch.setattr(jax, "__version__", version)
        assert use_cache() is None
        folders.append(in_use())
        assert in_use().parent == untold
    first, same, other_processor, other_version = folders
    assert first == same
    assert len({first, other_processor, other_version}) == 3


def test_accelerators_share_one_folder(untold, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert use_cache() is None
    assert in_use() == untold


def test_what_was_told_is_left_alone(folder, untold):
    executable_cache._set("jax_compilation_cache_dir", str(folder))
    assert use_cache() is None
    assert in_use() == folder
    executable_cache._set("jax_compilation_cache_dir", None)
    executable_cache._set("jax_enable_compilation_cache", False)
    try:
        assert use_cache() is None
        assert in_use() == Path("none")
    finally:
        executable_cache._set("jax_enable_compilation_cache", True)


def test_where_nothing_can_be_kept_one_line_says_so(untold, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    line = use_cache()
    assert line.startswith("programs are compiled at every start: cannot write")
    assert "\n" not in line
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(executable_cache, "CPUINFO", tmp_path / "none")
    assert describe_processor() is None
    assert use_cache().endswith("the type of this processor is unknown")
    assert in_use() == Path("none")


def compile_toy():
    """Compile the programs of the toy as a new process does, and run them."""
    jax.clear_caches()
    config = configs.load(None, SETTINGS)
    programs = compile_programs(*configs.build(config), config.eval_episodes, 1, "vmap")
    states = programs.init(jax.random.split(jax.random.key(3), 1))
    return np.asarray(programs.advance(states, np.int32(2)).states.learner.params["w"])


def programs_in(folder):
    return {path.name for path in folder.iterdir() if path.name.endswith("-cache")}


def test_programs_are_loaded_if_they_compute_the_same(folder, caplog):
    first = compile_toy()
    kept = programs_in(folder)
    assert len([name for name in kept if name.startswith("jit_over_seeds")]) == 3
    np.testing.assert_array_equal(compile_toy(), first)
    assert programs_in(folder) == kept
    assert not caplog.messages
    (record,) = folder.glob("*.sha256")
    record.write_text("0" * 64)  # As if the program had computed something else when it was new.
    np.testing.assert_array_equal(compile_toy(), first)
    (message,) = caplog.messages
    assert f"programs kept in {folder} computed something else" in message
    assert jax.config.jax_enable_compilation_cache


def test_other_flags_are_other_programs(folder, caplog, monkeypatch):
    """Check that programs are not compared with those of processes with other flags."""
    compile_toy()
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    compile_toy()
    assert len(list(folder.glob("*.sha256"))) == 2
    assert not caplog.messages


def test_a_damaged_program_is_compiled_anew(folder):
    first = compile_toy()
    for path in folder.glob("*-cache"):
        path.write_bytes(path.read_bytes()[:100])
    with pytest.warns(UserWarning, match="Error reading persistent compilation cache"):
        np.testing.assert_array_equal(compile_toy(), first)


@pytest.fixture
def load(folder):
    """`load(compile_all)`: load or compile a program that computes nothing."""
    program = SimpleNamespace(as_text=lambda: "program")
    return lambda compile_all: load_or_compile([program], compile_all, lambda _: np.zeros(2))


def test_a_program_is_locked_only_while_it_is_compiled(folder, load):
    locked = []

    def compile_all():
        with hold(next(folder.glob("*.lock"))) as is_free:
            locked.append(not is_free)

    load(compile_all)
    load(compile_all)
    assert locked == [True, False]


def test_one_compiles_and_those_that_waited_load_at_once(folder, load):
    """Let three others wait for a program, and each of them load it until all three do."""
    compiled, together = [], threading.Barrier(3)

    def compile_all():
        if list(folder.glob("*.sha256")):
            together.wait(timeout=20)
            return "loaded"
        compiled.append(1)
        time.sleep(0.2)  # Meanwhile the others come.
        return "compiled"

    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda _: load(compile_all), range(4)))
    assert sorted(results) == ["compiled", "loaded", "loaded", "loaded"]
    assert compiled == [1]


def test_a_record_appears_as_a_whole(folder, load, monkeypatch):
    """Stop before the record is in place, as a kill does, and compile again."""

    def stop(path, target):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", stop)
        with pytest.raises(KeyboardInterrupt):
            load(lambda: "killed")
    assert not list(folder.glob("*.sha256"))
    assert load(lambda: "compiled") == "compiled"
    assert len(list(folder.glob("*.sha256"))) == 1


def test_a_folder_that_is_deleted_meanwhile_costs_no_training(folder, load, caplog):
    def compile_all():
        shutil.rmtree(folder)
        return "compiled"

    assert load(compile_all) == "compiled"
    assert f"cannot keep programs in {folder}: No such file or directory" in caplog.text


def test_a_folder_that_cannot_be_made_costs_no_training(folder, load, caplog):
    folder.rmdir()
    folder.touch()
    assert load(lambda: "compiled") == "compiled"
    assert f"cannot keep programs in {folder}: " in caplog.text
