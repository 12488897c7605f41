"""The command `grid`: one sweep per combination of values, each in its own run folder."""

import signal

import pytest

from hmasd_jax.cli import train_commands
from hmasd_jax.cli.main import main
from hmasd_jax.cli.options import SweepOptions
from hmasd_jax.cli.parse import drop_options, load_config, parse
from hmasd_jax.training.signals import stop_on_signal

WORDS = ["grid", "--num-seeds", "2", "--vary", "algorithm.skill-interval=25,50"]


@pytest.fixture
def sweeps(monkeypatch):
    """Replace `seed_sweep`; return its calls, and a list of exit codes for the next calls."""
    calls, codes = [], []

    def pretend(config, options, words):
        calls.append((config, options, words))
        return codes.pop(0) if codes else 0

    monkeypatch.setattr(train_commands, "seed_sweep", pretend)
    return calls, codes


def test_a_sweep_per_value(sweeps, tmp_path, capsys):
    calls, _ = sweeps
    assert main([*WORDS, "--tensorboard", "--run-dir", str(tmp_path / "k")]) == 0
    assert [config.algorithm.skill_interval for config, _, _ in calls] == [25, 50]
    for value, (config, options, words) in zip((25, 50), calls):
        folder = tmp_path / "k" / f"skill_interval_{value}"
        assert options.run_dir == folder
        assert not options.resume
        assert config.num_seeds == 2
        # The command that makes this folder alone.
        assert words == [
            "seed_sweep", "--num-seeds", "2", "--tensorboard",
            "--algorithm.skill_interval", str(value), "--run-dir", str(folder),
        ]  # fmt: skip
    assert all(options.tensorboard for _, options, _ in calls)
    folders = " ".join(str(tmp_path / "k" / f"skill_interval_{value}") for value in (25, 50))
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == f"next: python -m hmasd_jax.train compare {folders}"


def test_several_settings_are_combined(sweeps, tmp_path):
    calls, _ = sweeps
    words = ["--vary", "algorithm.num-skills=2,3", "--run-dir", str(tmp_path)]
    assert main([*WORDS, *words]) == 0
    cells = [
        (config.algorithm.skill_interval, config.algorithm.num_skills) for config, _, _ in calls
    ]
    assert cells == [(25, 2), (25, 3), (50, 2), (50, 3)]
    _, options, words = calls[1]
    assert options.run_dir == tmp_path / "skill_interval_25_num_skills_3"
    assert words[3:7] == ["--algorithm.skill_interval", "25", "--algorithm.num_skills", "3"]


def test_settings_beside_a_new_algorithm_reach_it(sweeps, tmp_path):
    """Each cell has the configuration of the command line that it records."""
    calls, _ = sweeps
    words = ["grid", "--vary", "algorithm.name=hmasd,mappo", "--algorithm.ppo.num-envs", "8"]
    assert main([*words, "--run-dir", str(tmp_path)]) == 0
    assert [config.algorithm.ppo.num_envs for config, _, _ in calls] == [8, 8]
    for config, _, line in calls:
        assert load_config(*parse(SweepOptions, line[1:])) == config


def test_resume_continues_started_sweeps_and_starts_the_others(sweeps, tmp_path, capsys):
    calls, _ = sweeps
    (tmp_path / "skill_interval_50").mkdir()
    (tmp_path / "skill_interval_50/config.json").touch()
    words = [*WORDS, "--run-dir", str(tmp_path)]
    assert main(words) == 2
    assert "skill_interval_50 exists: continue with --resume" in capsys.readouterr().err
    assert not calls
    assert main([*words, "--resume"]) == 0
    assert [options.resume for _, options, _ in calls] == [False, True]


def test_a_sweep_whose_creation_was_cut_short_begins_again(sweeps, tmp_path):
    calls, _ = sweeps
    for value, files in [(25, []), (50, ["run.json", ".config.json.7.tmp"])]:
        (tmp_path / f"skill_interval_{value}").mkdir()
        for name in files:
            (tmp_path / f"skill_interval_{value}" / name).touch()
    assert main([*WORDS, "--run-dir", str(tmp_path), "--resume"]) == 0
    assert [options.resume for _, options, _ in calls] == [False, False]


def test_no_sweep_begins_if_the_folder_of_another_is_in_use(sweeps, tmp_path, capsys):
    calls, _ = sweeps
    (tmp_path / "skill_interval_50").mkdir()
    (tmp_path / "skill_interval_50/notes.txt").touch()
    assert main([*WORDS, "--run-dir", str(tmp_path)]) == 2
    assert "skill_interval_50 is not empty, and not a run folder" in capsys.readouterr().err
    assert not calls


def test_a_failed_sweep_does_not_keep_the_others_from_running(sweeps, tmp_path):
    calls, codes = sweeps
    codes += [train_commands.FAILED, 0]
    assert main([*WORDS, "--run-dir", str(tmp_path)]) == train_commands.FAILED
    assert len(calls) == 2


def test_an_interrupt_ends_all_and_says_how_to_go_on(sweeps, tmp_path, capsys):
    calls, codes = sweeps
    codes += [train_commands.INTERRUPTED]
    assert main([*WORDS, "--run-dir", str(tmp_path)]) == train_commands.INTERRUPTED
    assert len(calls) == 1
    again = f"{' '.join(WORDS)} --run-dir {tmp_path} --resume"
    line = f"interrupted; to continue: python -m hmasd_jax.train {again}"
    assert line in capsys.readouterr().out


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_at_the_end_of_a_sweep_ends_all(number, sweeps, tmp_path, monkeypatch):
    """Send a signal when the first cell has no further stretch to train, and so finishes."""
    calls, _ = sweeps
    pretend = train_commands.seed_sweep

    def finish(*args):
        with stop_on_signal():
            signal.raise_signal(number)
            return pretend(*args)

    monkeypatch.setattr(train_commands, "seed_sweep", finish)
    assert main([*WORDS, "--run-dir", str(tmp_path)]) == train_commands.INTERRUPTED
    assert len(calls) == 1


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ([], "--vary must name a setting and its values"),
        (["algorithm.skill_interval"], "--vary must name a setting and its values"),
        (["algorithm.skill_interval=25,"], "--vary must name a setting and its values"),
        (["algorithm.skill_interval=25,25"], "each once"),
        (["algorithm.skil_interval=25"], "did you mean skill_interval?"),
        (["algorithm.skill_interval=25,30"], "skill_interval 30"),
        (["algorithm.skill_interval=25", "algorithm.num_skills=0"], "num_skills"),
        (["algorithm.skill-interval=25", "algorithm.skill_interval=50"], "skill_interval twice"),
    ],
)
def test_no_sweep_begins_unless_all_can(sweeps, tmp_path, capsys, vary, message):
    words = ["grid", "--run-dir", str(tmp_path)]
    words += [word for value in vary for word in ("--vary", value)]
    assert main(words) == 2
    assert message in capsys.readouterr().err
    assert not sweeps[0]


def test_drops_options_with_their_values():
    words = ["--a", "1", "--run_dir=x", "--resume", "--vary", "b=1,2", "--b.c-d", "2"]
    assert drop_options(words, "vary", "run-dir", "resume") == ["--a", "1", "--b.c-d", "2"]
