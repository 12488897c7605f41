import importlib.util
import os
import re
import subprocess
import sys

import jax
import pytest

from hmasd_jax.cli import hints
from hmasd_jax.cli.main import COMMANDS, main
from hmasd_jax.cli.options import (
    EvaluateOptions,
    PlotOptions,
    RenderOptions,
    SweepOptions,
    TrainOptions,
)
from hmasd_jax.cli.parse import parse
from hmasd_jax.config import ConfigError, load
from hmasd_jax.config.from_table import Flag, Text


def run(*words):
    return subprocess.run(
        [sys.executable, "-m", "hmasd_jax.train", *words], capture_output=True, text=True
    )


def test_words_become_options_and_overrides():
    words = ["--config", "a.toml", "--resume", "--env.max-steps=3", "--seed", "-4", "--x.flag"]
    options, overrides = parse(SweepOptions, words)
    assert str(options.config) == "a.toml"
    assert options.resume
    assert not options.wandb
    assert overrides == {"env.max_steps": "3", "seed": "-4", "x.flag": "true"}
    assert [type(v) for v in overrides.values()] == [Text, Text, Flag]


@pytest.mark.parametrize(
    ("words", "indices"), [(["9", "10"], (9, 10)), (["9"], (9,)), (["[9, 10]"], (9, 10))]
)
def test_a_list_is_typed_as_words_or_as_in_toml(words, indices):
    name = "--algorithm.discriminator-obs"
    _, overrides = parse(TrainOptions, [name, *words, "--seed", "3"])
    loaded = load(None, overrides)
    assert loaded.algorithm.discriminator_obs == indices
    assert loaded.seed == 3


def test_hints_know_all_commands():
    assert (*COMMANDS,) == hints.COMMANDS


def test_runs_of_plot_need_no_name():
    words = ["a", "b", "--out", "c.png"]
    options, _ = parse(PlotOptions, words)
    assert list(map(str, options.runs)) == ["a", "b"]
    with pytest.raises(ConfigError, match="unexpected 'b': a is given already"):
        parse(EvaluateOptions, ["a", "b"])


@pytest.mark.parametrize("name", ["--seed-index", "--seed_index", "--seed"])
def test_render_still_knows_the_former_name_of_its_seed_index(name):
    options, overrides = parse(RenderOptions, [name, "3", "--out", "x.gif", "run"])
    assert options.seed_index == 3
    assert str(options.run) == "run"
    assert not overrides


@pytest.mark.parametrize("name", ["--placement", "--layout"])
def test_placement_and_its_former_name_are_the_same_setting(name):
    _, overrides = parse(SweepOptions, [name, "map", "--env.name", "overcooked"])
    assert load(None, overrides).placement == "map"


def test_a_word_after_a_flag_or_a_value_is_not_part_of_it():
    options, _ = parse(EvaluateOptions, ["--sampled", "--episodes", "3", "run"])
    assert (str(options.run), options.sampled, options.episodes) == ("run", True, 3)
    with pytest.raises(ConfigError, match="unexpected 'b'"):
        parse(TrainOptions, ["--algorithm.skill-prior", "--run-dir", "a", "b"])


@pytest.mark.parametrize(
    ("words", "sampled"), [(["--sampled", "false"], False), (["--sampled", "True"], True)]
)
def test_a_flag_may_have_a_value_like_a_setting(words, sampled):
    options, _ = parse(EvaluateOptions, [*words, "run"])
    assert (options.sampled, str(options.run)) == (sampled, "run")


@pytest.mark.parametrize(
    ("cls", "words", "repeated"),
    [
        (TrainOptions, ["--run-dir", "a", "--seed", "3"], []),
        (TrainOptions, ["--seed-index", "2", "--wandb"], ["--wandb", "--seed-index", "2"]),
        (SweepOptions, ["--distributed", "--config", "b"], ["--distributed"]),
    ],
)
def test_options_to_repeat_when_a_run_is_resumed(cls, words, repeated):
    assert parse(cls, words)[0].repeated == repeated


MISTAKES = [
    (["trian"], "unknown command 'trian' (did you mean train?)"),
    (["train", "x"], "unexpected 'x': settings are written --name value"),
    (["train", "--run-dir", "a", "b"], "unexpected 'b': settings are written --name value"),
    (["train", "--seed"], "seed needs a value"),
    (["train", "--seed", "x"], "seed must be a whole number, got 'x'"),
    (["train", "--seed-index", "-1"], "seed_index must be at least 0, got -1"),
    (["train", "--algorithm.skil-interval", "5"], "(did you mean skill_interval?)"),
    (["train", "--config", "none.toml"], "cannot read config file none.toml"),
    (["train", "--resume", "--run-dir", "nope"], "nope is not a run folder"),
    (["train", "--algorithm.discriminator-obs", "x"], "must be a whole number, got 'x'"),
    (["train", "--seed", "1", "2"], "seed must be a whole number, got [1, 2]"),
    (["train", "--algorithm.discriminator-obs", "[9, 9]"], "indices from 0, each once, got [9, 9]"),
    (["train", "--algorithm.discriminator-obs", "[11]"], "index 11, but obs has 11 features"),
    (
        ["grid", "--vary", "algorithm.discriminator-obs=[1],[11]"],
        "index 11, but obs has 11 features",
    ),
    (["seed_sweep", "--resume"], "--resume needs --run-dir"),
    (["train", "--config", "none"], "cannot read config file none"),
    (["tune", "--resume", "--run-dir", "nope"], "nope is not a search: it has no preset.json"),
    (["plot", "run", "--out", "curves"], "--out must end in .png, .pdf, .svg; got curves"),
    (["compare", "run", "--out", "c.csv"], "--out must end in .png, .pdf, .svg; got c.csv"),
    (["compare", "run", "--solved-at", "nan"], "solved_at must be finite, got nan"),
    (["report", "run", "--solved-at", "inf"], "solved_at must be finite, got inf"),
    (["seed_sweep", "--num-seeds", "0"], "num_seeds must be between 1 and 100000, got 0"),
    (["seed_sweep", "--seed-index", "3"], "unknown option --seed_index"),
    (["train", "--skill-interval", "5"], "did you mean algorithm.skill_interval?"),
    (["train", "--lr", "0.1"], " or algorithm.ppo.learning_rate?)"),
    (["train", "--algorithm.num-envs", "4"], "(did you mean algorithm.ppo.num_envs?)"),
    (
        ["train", "--algorithm.name", "qmix", "--algorithm.num-envs", "4"],
        "(did you mean algorithm.q_learning.num_envs?)",
    ),
    (["seed_sweep", "--seeds", "3"], "unknown option --seeds (did you mean num_seeds?)"),
    (["train", "--rundir", "x"], "unknown option --rundir (did you mean run_dir?)"),
    (["train", "--confg", "x"], "unknown option --confg (did you mean config?)"),
    (["grid", "--vary", "skill-interval=5"], "(did you mean algorithm.skill_interval?)"),
    (["seed_sweep", "--layout", "map", "--placement", "map"], "layout is the former name of plac"),
    (["seed_sweep", "--layout", "mpa"], "placement must be one of auto, workers, vmap, map"),
    (["seed_sweep", "--placment", "map"], "unknown option --placment (did you mean placement?)"),
    (["seed_sweep", "--num-seeds", "1e30"], "num_seeds must be between 1 and 100000"),
    (["train", "--num-seeds", "1\nseed = 3"], "num_seeds must be a whole number, got '1\\nseed"),
    (["train", "--seed-index", "4e9"], "seed_index must be at most 2147483647, got 4000000000"),
    (["train", "--env.name.x", "3"], "unknown env.name "),
    (["train", "--eval_episodes", "1e12"], "eval_episodes must be between 1 and 1000000"),
    (["grid", "--vary", "seed=1 #/../x"], "--vary: '1 #/../x' cannot name a folder"),
    (["grid", "--vary", "env.observation=../x"], "--vary: '../x' cannot name a folder"),
    (["grid", "--vary", "seed/../x=1"], "unknown key seed/"),
    (["evaluate"], "run is missing"),
    (["evaluate", "none"], "none is not a run folder"),
    (["evaluate", "none", "--episodes", "0"], "episodes must be at least 1, got 0"),
    (["evaluate", "none", "--epsodes", "5"], "unknown option --epsodes (did you mean episodes?)"),
    (["render", "none"], "none is not a run folder"),
    (
        ["train", "--config", "configs/none/hmasd.toml"],
        "cannot read config file configs/none/hmasd.toml: No such file",
    ),
    (["render", "none", "--out", "x.gif", "--fps", "0"], "fps must be between 0.1 and 100, got 0"),
    (["render", "none", "--out", "x.gif", "--fps", "-5"], "fps must be between 0.1 and 100, got"),
    (["render", "none", "--out", "x.gif", "--fps", "1e9"], "fps must be between 0.1 and 100, got"),
    (["render", "none", "--out", "x.gif", "--fps", "nan"], "fps must be finite, got nan"),
    (["plot"], "runs is missing"),
    (["plot", "none"], "none is not a run folder"),
    (["report"], "runs is missing"),
    (["report", "none"], "none is not a run folder"),
    (["report", "none", "--serve"], "none is not a run folder"),
    (["report", "none", "--port", "70000"], "port must be between 0 and 65535, got 70000"),
    (["report", "none", "--megabytes", "3"], "megabytes must be at least 6, got 3"),
]


@pytest.mark.parametrize(("words", "message"), MISTAKES, ids=lambda x: " ".join(x)[:40])
def test_a_mistake_is_one_line_and_leaves_nothing_behind(
    words, message, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.startswith("error: ")
    assert message in output.err
    assert output.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("extra", ["tensorboard", "wandb"])
def test_a_missing_optional_package_is_told_before_anything_starts(
    extra, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main(["train", f"--{extra}"]) == 2
    assert f"uv pip install -c constraints.txt -e '.[{extra}]'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.fixture
def without(monkeypatch):
    """`without(package)`: make an optional package absent, also for modules that had it."""

    def remove(package):
        for name in list(sys.modules):
            if name.split(".")[0] == package or name.startswith("hmasd_jax.report."):
                monkeypatch.delitem(sys.modules, name)
        monkeypatch.setitem(sys.modules, package, None)

    return remove


@pytest.mark.parametrize("package", ["plotly", "jinja2", "imageio", "PIL", "matplotlib"])
@pytest.mark.parametrize("more", [[], ["--serve"]])
def test_a_report_tells_which_package_it_lacks(package, more, without, capsys, tmp_path):
    without(package)
    assert main(["report", str(tmp_path), *more]) == 2
    remedy = (
        f"a report needs the package {package}: uv pip install -c constraints.txt -e '.[report]'"
    )
    assert capsys.readouterr().err == f"error: {remedy}\n"


def test_help_explains_every_field(capsys):
    assert main(["seed_sweep", "--help", "--env.observation", "one_hot", "--seed", "7"]) == 0
    text = capsys.readouterr().out
    for name in ("--config", "--run-dir", "--resume", "--num-seeds", "--placement"):
        assert name in text
    for name in ("--env.max-steps", "--algorithm.skill-interval", "--algorithm.ppo.learning-rate"):
        assert name in text
    words = " ".join(re.sub(r"[│\n]", " ", text).split())
    assert "k, environment steps between two skill assignments" in words
    assert "(default: one_hot)" in words
    assert "(default: 7)" in words


def test_help_explains_by_its_name_what_may_be_an_object(capsys):
    assert (
        main(["train", "--help", "--env.name", "micro_battle", "--env.scenario", "2m_vs_1z"]) == 0
    )
    text = capsys.readouterr().out
    assert "--env.scenario NAME" in text
    assert "(default: 2m_vs_1z)" in " ".join(re.sub(r"[│\n]", " ", text).split())


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command, capsys):
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert COMMANDS[command].summary.split()[0] in text
    assert f"hmasd_jax.train {command}" in text


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_finds_its_function(command):
    assert callable(COMMANDS[command].load())


def test_without_a_command_the_commands_are_listed(capsys):
    assert main([]) == 2
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(text.count(f"  {name} ") == 2 for name in COMMANDS)


@pytest.mark.parametrize(
    ("words", "code", "slow"),
    [
        (["--help"], 0, {"jax", "numpy", "rich"}),
        (["render", "--help"], 0, {"jax", "numpy"}),
        (["train", "--help"], 0, {"distrax", "orbax", "tensorflow_probability", "matplotlib"}),
        (["train", "--num-seeds", "x"], 2, {"distrax", "orbax", "matplotlib"}),
    ],
)
def test_help_and_mistakes_do_not_wait_for_slow_imports(words, code, slow):
    program = (
        "import sys; from hmasd_jax.train import main; "
        "print(main(sys.argv[1:]), *sys.modules, file=sys.stderr)"
    )
    command = [sys.executable, "-c", program, *words]
    done = subprocess.run(command, capture_output=True, text=True)
    result, *imported = done.stderr.splitlines()[-1].split()
    assert int(result) == code
    assert not slow & set(imported)


@pytest.mark.parametrize(
    "reason",
    ["RESOURCE_EXHAUSTED: Out of memory\nmore", "INTERNAL: Failed to initialize BLASLT support"],
)
def test_too_little_memory_of_the_device_is_one_line(reason, monkeypatch, capsys):
    def fail(*_):
        raise jax.errors.JaxRuntimeError(reason)

    monkeypatch.setattr("hmasd_jax.cli.inspect_commands.plot", fail)
    assert main(["plot", "run"]) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"error: the device has too little memory: {reason.splitlines()[0]}; ")
    assert "--algorithm.ppo.num-envs" in error
    assert error.count("\n") == 1


def test_other_errors_of_the_device_are_shown_in_full(monkeypatch):
    def fail(*_):
        raise jax.errors.JaxRuntimeError("INTERNAL: something else")

    monkeypatch.setattr("hmasd_jax.cli.inspect_commands.plot", fail)
    with pytest.raises(jax.errors.JaxRuntimeError, match="something else"):
        main(["plot", "run"])


def test_exit_code_of_the_process():
    done = run("train", "--seed", "x")
    assert done.returncode == 2
    assert done.stderr == "error: seed must be a whole number, got 'x'\n"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("file", "file is a file: choose another --run-dir"),
        ("folder", "folder is not empty, and not a run folder: choose another --run-dir"),
        ("run", "run exists: continue it with --resume, or choose another --run-dir"),
    ],
)
def test_a_path_in_use_is_no_run_folder(name, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for file in ("file", "folder/notes.txt", "run/config.json"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text("")
    assert main(["train", "--run-dir", name]) == 2
    assert capsys.readouterr().err == f"error: {message}\n"
    assert (tmp_path / "run/config.json").read_text() == ""


def test_a_full_device_is_told_in_one_line():
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "hmasd_jax.train", "--help"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    assert done.stderr == "error: cannot write the help: No space left on device\n"


@pytest.mark.parametrize("words", [["--help"], ["plot", "--help"], ["train", "--help"]])
def test_a_reader_of_the_help_may_leave_early(words):
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "hmasd_jax.train", *words]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")
