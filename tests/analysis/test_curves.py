import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from envs_jax import MissingPackageError
from hmasd_jax.analysis import curves as plot
from hmasd_jax.analysis import figures
from hmasd_jax.runs.folder import RunError
from tests.helpers.runs import write_run


@pytest.fixture
def run(tmp_path):
    return write_run(tmp_path / "run", [[0.0, 0.5, 0.75, 1.0], [0.0, 0.25, 0.5]])


def is_png(path: Path) -> bool:
    return path.read_bytes().startswith(b"\x89PNG")


def test_draws_runs(run, tmp_path):
    other = write_run(tmp_path / "other", [[0.1, 0.2]])
    out = tmp_path / "plots" / "curves.png"
    assert plot.plot_runs([run, other], out) == out
    assert is_png(out)
    assert is_png(plot.plot_runs([run], tmp_path / "length.png", metric="length"))


def test_reads_whole_curves_and_their_common_steps(run):
    curves = plot.read_curves(run, "eval", "success")
    assert {seed: len(steps) for seed, (steps, _) in curves.items()} == {0: 4, 1: 3}
    steps, values = plot.common_steps(list(curves.values()))
    np.testing.assert_array_equal(steps, [0, 100, 200])
    np.testing.assert_array_equal(values, [[0.0, 0.5, 0.75], [0.0, 0.25, 0.5]])


def test_common_steps_of_seeds_without_any():
    steps, values = plot.common_steps(
        [(np.array([0.0]), np.ones(1)), (np.array([1.0]), np.ones(1))]
    )
    assert (steps.shape, values.shape) == ((0,), (2, 0))


def test_a_line_cut_short_by_a_kill_is_left_out(run):
    path = run / "seed_1" / "metrics.jsonl"
    path.write_text(path.read_text()[:-10])
    assert len(plot.read_curves(run, "train", "discriminators/team_accuracy")[1][0]) == 2


def test_mean_and_band(run):
    from matplotlib.figure import Figure

    axes = Figure().add_subplot()
    curves = [(np.arange(2.0), np.array([0.0, 1.0])), (np.arange(2.0), np.array([0.5, 1.0]))]
    plot.draw_curves(axes, curves, "name", show_seeds=True)
    *seeds, mean = axes.lines
    assert len(seeds) == 2
    np.testing.assert_array_equal(mean.get_ydata(), [0.25, 1.0])
    # Two seeds: means of two draws from {0, 1/2} reach from 0 to 1/2 in 95 % of samples.
    corners = axes.collections[0].get_paths()[0].vertices
    assert (corners[:, 1].min(), corners[:, 1].max()) == (0.0, 1.0)
    assert {y for x, y in corners.tolist() if x == 0.0} == {0.0, 0.5}


@pytest.mark.parametrize(
    ("metric", "scale", "label"),
    [("success", 1, "  its final 74% ± 26% (std)"), ("return", 100, "  its final 74 ± 26 (std)")],
)
def test_draws_a_result_beside_another(tmp_path, monkeypatch, metric, scale, label):
    drawn = []
    monkeypatch.setattr(plot, "save", lambda figure, out: drawn.append(figure) or out)
    values = (scale * np.array([[0.0, 0.5, 1.0], [0.1, 0.6, 0.9]])).tolist()
    result = tmp_path / "hmasd.json"
    record = {"metric": metric, "env_steps": [0, 10, 20], "values": values}
    result.write_text(json.dumps(record))
    final = 0.74 * scale, 0.26 * scale
    other = plot.Reference("paper", (5, 15), (0.2 * scale, 0.7 * scale), final)
    plot.plot_result(result, tmp_path / "result.png", other)
    result.write_text(json.dumps(record | {"values": values[:1]}))
    plot.plot_result(result, tmp_path / "alone.png")
    legends = [figure.axes[0].get_legend_handles_labels()[1] for figure in drawn]
    assert legends == [["hmasd (2 seeds)", "paper", label], ["hmasd (1 seed)"]]


def test_a_seed_that_was_stopped_keeps_its_last_value(tmp_path):
    result = tmp_path / "mat.json"
    result.write_text(json.dumps({"env_steps": [0, 10, 20], "values": [[0.0, 0.5, 1.0], [0.25]]}))
    label, (whole, stopped) = plot.recorded_curves(result)
    assert label == "mat (2 seeds)"
    np.testing.assert_array_equal(whole, ([0, 10, 20], [0.0, 0.5, 1.0]))
    np.testing.assert_array_equal(stopped, ([0, 10, 20], [0.25, 0.25, 0.25]))


def test_labels_are_algorithms_only_if_they_differ(tmp_path):
    tables = [{"algorithm": {"name": name}} for name in ("hmasd", "mappo")]
    runs = [tmp_path / "a", tmp_path / "b"]
    for folder in runs:
        (folder / "seed_0").mkdir(parents=True)
    assert plot.labels_of(runs, tables, [[0], [0, 1]]) == ["hmasd (1 seed)", "mappo (2 seeds)"]
    assert plot.labels_of(runs, [tables[0]] * 2, [[0], []]) == ["a (1 seed)", "b (0 seeds)"]


def test_folders_of_one_name_are_told_apart_by_their_parents(tmp_path):
    runs = [tmp_path / a / b / "trial_0" for a, b in (("x", "one"), ("x", "two"), ("y", "two"))]
    for folder in runs:
        (folder / "seed_0").mkdir(parents=True)
    tables = [{"algorithm": {"name": "hmasd"}}] * 3
    labels = [f"{a}/{b}/trial_0 (1 seed)" for a, b in (("x", "one"), ("x", "two"), ("y", "two"))]
    assert plot.labels_of(runs, tables, [[0]] * 3) == labels
    assert plot.labels_of([runs[0], runs[0]], tables[:2], [[0]] * 2) == ["trial_0 (1 seed)"] * 2


def test_runs_whose_names_begin_with_an_underscore_are_labeled_too(tmp_path):
    runs = [write_run(tmp_path / name, [[0.0, 1.0]]) for name in ("_a", "_b")]
    assert is_png(plot.plot_runs(runs, tmp_path / "curves.png"))


def test_data_beside_a_figure_name_the_seeds_of_the_run(run, tmp_path):
    (run / "seed_1").rename(run / "seed_7")
    plot.plot_runs([run], tmp_path / "curves.png")
    with (tmp_path / "curves.csv").open() as file:
        assert {row["seed"] for row in csv.DictReader(file)} == {"0", "7"}


def test_errors_are_one_line(run, tmp_path):
    out = tmp_path / "x.png"
    with pytest.raises(RunError, match=r"no evaluation of reward yet: there are length, success"):
        plot.plot_runs([run], out, metric="reward")
    with pytest.raises(RunError, match="is not a run folder"):
        plot.plot_runs([tmp_path], out)
    empty = write_run(tmp_path / "empty", [])
    with pytest.raises(RunError, match="wait for its first one"):
        plot.plot_runs([empty], out)
    assert not out.exists()
    with pytest.raises(RunError, match=r"cannot write .*x.strange: Format 'strange' is not supp"):
        plot.plot_runs([run], tmp_path / "x.strange")


def test_missing_package_names_the_command(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError) as error:
        plot.plot_runs([run], tmp_path / "x.png")
    assert str(error.value) == (
        "plotting needs the package matplotlib: uv pip install -c constraints.txt -e '.[plots]'"
    )
    assert isinstance(error.value, MissingPackageError)


def test_seeds_are_not_drawn_unless_asked_for():
    from matplotlib.figure import Figure

    axes = Figure().add_subplot()
    curves = [(np.arange(2.0), np.array([0.0, 1.0]))] * 3
    line = plot.draw_curves(axes, curves, "name")
    assert line.get_xydata()[-1].tolist() == [1.0, 1.0]
    assert len(axes.lines) == 1


def test_more_than_five_curves_get_more_panels_with_labels_at_their_ends(tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(figures, "save", lambda figure, out: kept.append(figure) or out)
    flat = [(np.arange(30.0), np.zeros(30))] * 2
    groups = [(f"run {i}", flat) for i in range(6)]
    figures.draw_groups(groups, "task", "success", tmp_path / "x.png")
    panels = kept[0].axes
    assert [len(axes.lines) for axes in panels] == [3, 3]
    for axes in panels:
        styles = {(str(line.get_linestyle()), line.get_marker()) for line in axes.lines}
        assert len(styles) == 3  # Curves that coincide are told apart.
        assert len({line.get_markevery() for line in axes.lines}) == 3
        heights = sorted(text.xyann[1] for text in axes.texts)
        assert min(np.diff(heights)) > 0.07
    labels = [text.get_text() for axes in panels for text in axes.texts]
    assert labels == [f"run {i}" for i in range(6)]
    assert "95 % bootstrap interval" in panels[-1].get_xlabel()


def test_labels_stay_within_the_axes():
    places = figures._spread(np.array([0.1, 0.98, 0.99, 1.0]), gap=0.1)
    np.testing.assert_allclose(places, [0.1, 0.8, 0.9, 1.0])


@pytest.mark.parametrize("suffix", [".pdf", ".svg"])
def test_vector_figures_keep_their_text_and_come_with_numbers(run, tmp_path, suffix):
    out = tmp_path / "plots" / f"curves{suffix}"
    assert plot.plot_runs([run], out) == out
    data = out.read_bytes()
    assert b"environment steps" in data if suffix == ".svg" else data.startswith(b"%PDF")
    assert b"/Type3" not in data
    lines = out.with_suffix(".csv").read_text().splitlines()
    assert lines[0] == "label,seed,env_steps,success"
    assert lines[4] == "hmasd (2 seeds),0,300,1.0"
    assert len(lines) == 1 + 4 + 3
