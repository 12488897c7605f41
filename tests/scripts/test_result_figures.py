"""Images of recorded results show few configurations, each in a color of its own."""

from pathlib import Path

import pytest

from hmasd_jax.analysis.figures import COLORS
from scripts import paper, record_result, result_figures

IMAGES = [
    (task, name, paths)
    for task in paper.TASKS
    for name, paths in result_figures.shown(record_result.recorded(task)).items()
]


@pytest.mark.parametrize(("task", "name", "paths"), IMAGES)
def test_every_configuration_has_a_color_of_its_own(task, name, paths):
    numbers = result_figures.styles_of([path.stem for path in paths])
    assert len(set(numbers)) == len(numbers) <= len(COLORS)


def test_a_configuration_looks_the_same_in_all_images():
    assert result_figures.styles_of(["hmasd", "mappo", "x"]) == [0, 2, 1]
    assert result_figures.styles_of(["mappo", "hmasd_general", "x", "y"]) == [2, 1, 0, 3]


def test_retired_presets_ablations_and_other_skills_have_images_of_their_own():
    names = ("hmasd", "hmasd_robust_again", "hmasd_num_skills_5", "mappo", "nohigh")
    shown = result_figures.shown([Path(f"{name}.json") for name in names])
    assert {name: [path.stem for path in paths] for name, paths in shown.items()} == {
        "compared": ["hmasd", "mappo"],
        "retired": ["hmasd", "hmasd_robust_again"],
        "ablations": ["hmasd", "nohigh"],
        "num_skills": ["hmasd", "hmasd_num_skills_5"],
    }
    assert result_figures.shown([Path("hmasd.json")]) == {}


def test_other_seeds_of_a_preset_are_shown_beside_it():
    names = (
        "hmasd", "hmasd_general", "hmasd_general_again", "hmasd_general_before",
        "hmasd_general_unmixed", "mappo", "mappo_general", "mappo_general_before",
    )  # fmt: skip
    shown = result_figures.shown([Path(f"{name}.json") for name in names])
    assert {name: [path.stem for path in paths] for name, paths in shown.items()} == {
        "presets": ["hmasd", "mappo", "hmasd_general", "mappo_general"],
        "compared": ["hmasd", "hmasd_general", "mappo"],
        "general": ["hmasd", "hmasd_general", "hmasd_general_again", "mappo_general"],
        "previous": ["hmasd_general", "hmasd_general_unmixed"],
        "earlier": ["hmasd_general", "hmasd_general_before"],
        "earlier_mappo": ["mappo_general", "mappo_general_before"],
    }
