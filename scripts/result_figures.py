"""Images that show the recorded results of a task together."""

import json
from collections.abc import Sequence
from pathlib import Path

from hmasd_jax.analysis.curves import recorded_curves
from hmasd_jax.analysis.figures import draw_groups
from scripts.records import RESULTS

SKILLS = ("skill_interval", "num_team_skills", "num_skills")
"""Settings that the paper's Fig. 10 varies; runs are named after them."""
TOGETHER = (
    "presets", "compared", "general", "previous", "earlier", "earlier_mappo", "retired",
    "ablations", *SKILLS,
)  # fmt: skip
"""Names of the images that show several runs."""
RETIRED = ("hmasd_robust", "hmasd_lambda", "hmasd_terminal")
"""Beginnings of the names of runs with retired presets."""
EARLIER = (
    "hmasd_general_before", "hmasd_general_clipped", "hmasd_general_coordinator",
    "hmasd_general_both_levels",
)  # fmt: skip
"""Beginnings of the names of runs with earlier forms of the general preset."""
PREVIOUS = (
    "hmasd_general_unsharpened", "hmasd_general_unmixed", "hmasd_general_per_value",
    "hmasd_general_small_odds", "hmasd_general_by_agent", "hmasd_general_whole",
)  # fmt: skip
"""Beginnings of the names of runs with its last forms before today's."""
EARLIER_MAPPO = ("mappo_general_",)
"""Beginnings of the names of runs with earlier forms of MAPPO's general preset."""
GENERAL = ("hmasd_general_", "mappo_general", "hmasd_cpu")
"""Beginnings of the names of other runs with presets in use, beside `hmasd_general` and `hmasd`."""
PRESETS = ("hmasd", "mappo", "hmasd_general", "mappo_general")
"""Runs of HMASD and MAPPO with the paper's settings and with ours."""
STYLES = ("hmasd", "hmasd_general", "mappo", "mat", "maser", "eiti", "edti")
"""Configurations that look the same in all images."""


def shown(files: Sequence[Path]) -> dict[str, list[Path]]:
    """Return the files that each image shows, beside those of the presets in use."""
    rest = list(files)

    def named(*names: str) -> list[Path]:
        return [path for name in names for path in files if path.stem == name]

    def take(*beginnings: str) -> list[Path]:
        found = [path for path in rest if path.stem.startswith(beginnings)]
        rest[:] = [path for path in rest if path not in found]
        return found

    retired, earlier, previous = take(*RETIRED), take(*EARLIER), take(*PREVIOUS)
    earlier_mappo, general, ablations = take(*EARLIER_MAPPO), take(*GENERAL), take("no")
    skills = [take(f"hmasd_{setting}") for setting in SKILLS]
    full, ours, mappo = named("hmasd"), named("hmasd_general"), named("mappo_general")
    presets = named(*PRESETS)
    presets = presets if len(presets) == len(PRESETS) else []
    systems = [path for path in rest if path not in full]
    beside = ([], full, full + ours, ours, ours, mappo, *[full] * len(TOGETHER[6:]))
    groups = (
        presets, systems, general, previous, earlier, earlier_mappo, retired, ablations, *skills,
    )  # fmt: skip
    return {name: base + group for name, base, group in zip(TOGETHER, beside, groups) if group}


def styles_of(names: Sequence[str]) -> list[int]:
    """Return a number per configuration: its place in `STYLES`, or the smallest that is free."""
    taken = {STYLES.index(name) for name in names if name in STYLES}
    free = iter(number for number in range(len(STYLES) + len(names)) if number not in taken)
    return [STYLES.index(name) if name in STYLES else next(free) for name in names]


def draw_together(task: str, files: Sequence[Path]) -> None:
    """Draw the images of a task, each configuration in one color."""
    metric = json.loads(files[0].read_text())["metric"]
    for name, paths in shown(files).items():
        draw(paths, task, metric, RESULTS / task / f"{name}.png")


def draw(files: Sequence[Path], title: str, metric: str, out: Path) -> Path:
    """Draw recorded results, each in the style of its configuration."""
    groups = [recorded_curves(path) for path in files]
    styles = styles_of([path.stem for path in files])
    return draw_groups(groups, title, metric, out, styles=styles)
