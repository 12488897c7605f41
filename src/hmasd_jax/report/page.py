"""The page: one HTML file with script, films and pictures inside, and its data beside it."""

import csv
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from envs_jax.declared import name_actions
from envs_jax.optional import require
from hmasd_jax.analysis.curves import labels_of, read_curves
from hmasd_jax.analysis.learning import Band, common_metric, curve_rows, default_bar
from hmasd_jax.analysis.skills import Track, conditions
from hmasd_jax.analysis.usefulness import table
from hmasd_jax.config import to_json
from hmasd_jax.hmasd.config import count_skills
from hmasd_jax.report.gather import Run, gather
from hmasd_jax.report.search_views import SearchView, expand, view_searches
from hmasd_jax.report.template import load_template
from hmasd_jax.runs import checkpoint
from hmasd_jax.runs.folder import RunError, checkpoint_folder, read_config, seeds_of

DEFAULT_MEGABYTES = 15.0
FIXED_BYTES = 5_600_000
"""Plotly's script (4.8 MB), and text and charts of a usual run."""
FRAME_BYTES = 9_000
"""Usual size of one frame of the player."""
LEAST_FILM_BYTES = 20_000
FIRST_METRICS = {
    "entropies": ("entropy",),
    "accuracies": ("accuracy",),
    "losses": ("loss", "error", "kl", "grad_norm", "clip_fraction"),
}
"""Groups of training metrics by parts of their names."""


def write_report(
    runs: Sequence[Path],
    out: Path,
    episodes: int = 100,
    num_seeds: int = 3,
    megabytes: float = DEFAULT_MEGABYTES,
    solved_at: float | None = None,
    track: Track = iter,
) -> Path:
    """Write a report of runs as one HTML file, and its data as CSV beside it.

    Args:
        runs: Folders of runs, finished or still training. They are only read. The folder of a
            search stands for its preset and its best trial.
        out: File to write, .html. `OUT_curves.csv` and `OUT_skills.csv` go beside it.
        episodes: Episodes per skill and condition.
        num_seeds: Most seeds per run whose skills are shown.
        megabytes: Size limit. Films become shorter to keep it.
        solved_at: Score from which a seed has solved the task; None takes a success rate of 0.9,
            or any return above 0.
        track: Wrapper of loops, e.g. a progress bar.

    Returns:
        `out`.

    Raises:
        MissingPackageError: A package of the extra `report` is not installed.
        RunError: A folder is not the folder of a run, its metrics are damaged, or `out` cannot be
            written.
        ConfigError: The configuration of a run is not valid in this version.
    """
    check_packages()
    folders = expand(runs)
    for run in folders:
        read_config(run)  # raises the errors
    out = check_out(Path(out), [Path(run) for run in runs])
    found = gather_runs(folders, episodes, num_seeds, solved_at, track)
    data = [path.name for path in data_paths(out)]
    page = render_page(found, megabytes, track, data, searches=view_searches(runs))
    write_data(found, out)
    out.write_text(page, encoding="utf-8")
    return out


def check_packages() -> None:
    """Check that the packages of the extra `report` are installed.

    Raises:
        MissingPackageError: One of them is missing.
    """
    for package in ("jinja2", "plotly", "imageio", "imageio_ffmpeg", "PIL", "matplotlib"):
        require(package, "report", "a report")


def gather_runs(
    runs: Sequence[Path], episodes: int, num_seeds: int, solved_at: float | None, track: Track
) -> list[Run]:
    """Gather all runs of a report, judged by one metric; see `write_report`."""
    tables = [to_json(read_config(run)) for run in runs]
    metric = common_metric(runs)
    bar = default_bar(metric) if solved_at is None else solved_at
    labels = labels_of(list(runs), tables, [read_curves(run, "eval", metric) for run in runs])
    return [
        gather(run, label, metric, episodes, num_seeds, bar, track)
        for run, label in zip(runs, labels)
    ]


def check_out(out: Path, runs: Sequence[Path]) -> Path:
    """Check, before anything is played, that the page can be written and is not in a run.

    Raises:
        RunError: It cannot be.
    """
    if out.suffix not in (".html", ".htm"):
        raise RunError(f"cannot write {out}: choose a name that ends in .html")
    if any(out.resolve().is_relative_to(run.resolve()) for run in runs):
        raise RunError(
            f"cannot write {out}: a report never writes into a run; choose another --out"
        )
    is_new = not out.exists()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with out.open("a"):
            pass
    except OSError as error:
        raise RunError(f"cannot write {out}: {error.strerror or error}") from error
    if is_new:
        out.unlink()
    return out


def count_tracked(run: Path, num_seeds: int) -> int:
    """Return the number of turns of the loops that `write_report` tracks for a run, at most."""
    config = read_config(run)
    counts = count_skills(config.algorithm)
    ready = [seed for seed in seeds_of(run) if checkpoint.steps(checkpoint_folder(run, seed))]
    return min(len(ready), num_seeds) * (len(conditions(*counts, config.env.num_agents)) + 1)


def render_page(
    runs: list[Run],
    megabytes: float = DEFAULT_MEGABYTES,
    track: Track = iter,
    data: Sequence[str] = (),
    live: str | None = None,
    searches: Sequence[SearchView] = (),
) -> str:
    """Return the HTML of the page.

    Args:
        runs: What to show.
        megabytes: Size limit.
        track: Wrapper of loops, e.g. a progress bar.
        data: Names of the files beside the page.
        live: Version of a served page, which loads itself again when the version has changed; None
            for a file.
        searches: Searches that some of the runs belong to.
    """
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs

    from hmasd_jax.report.charts import draw_bands, embed
    from hmasd_jax.report.skill_views import view_seed

    film_limit, frames = share_bytes(runs, megabytes)
    views = [
        [
            view_seed(seed, f"run{i}-seed{seed.index}", film_limit, frames)
            for seed in track(run.seeds)
        ]
        for i, run in enumerate(runs)
    ]

    def chart(kind: str, metric: str, name: str, height: int = 380) -> str:
        curves = [(run.label, getattr(run, kind).get(metric)) for run in runs]
        title = f"{'evaluation' if kind == 'evaluation' else 'training'}: {metric}"
        return embed(draw_bands(curves, metric, title, height), name)

    return load_template("report.html.j2").render(
        runs=list(zip(range(len(runs)), runs, views)),
        title=", ".join(dict.fromkeys(run.task for run in runs)),
        metric=runs[0].metric,
        chart=chart,
        groups=group_metrics([run.training for run in runs], [run.evaluation for run in runs]),
        plotly=Markup(get_plotlyjs()),
        data=data,
        live=live,
        searches=searches,
        version=version("hmasd_jax"),
        limit=megabytes,
    )


def share_bytes(runs: list[Run], megabytes: float) -> tuple[int, int]:
    """Divide the size limit: return the bytes per film, and the frames per player."""
    studies = [seed.study for run in runs for seed in run.seeds]
    free = megabytes * 1e6 - FIXED_BYTES
    frames = int(max(free * 0.5 / max(len(studies), 1) / FRAME_BYTES, 10))
    films = sum(max(len(study.films) - 1, 1) for study in studies)
    # A data URI is a third longer than its data. Posters and maps take about 20 kB.
    film_limit = int(free * 0.5 / max(films, 1) * 0.75) - 20_000
    return max(film_limit, LEAST_FILM_BYTES), frames


def group_metrics(
    training: list[dict[str, Band]], evaluation: list[dict[str, Band]]
) -> dict[str, list[tuple[str, str]]]:
    """Return the kinds and names of metrics for the charts that are shown on demand, by group."""
    names = dict.fromkeys(name for found in training for name in found)
    groups: dict[str, list[tuple[str, str]]] = {
        "evaluations": [("evaluation", n) for n in dict.fromkeys(n for e in evaluation for n in e)]
    }
    for name in names:
        last = name.rpartition("/")[2]
        matching = (g for g, parts in FIRST_METRICS.items() if any(p in last for p in parts))
        groups.setdefault(next(matching, "other training metrics"), []).append(("training", name))
    return groups


def data_paths(out: Path) -> tuple[Path, Path]:
    """Return the CSV files beside a page: curves and skills."""
    return out.with_name(f"{out.stem}_curves.csv"), out.with_name(f"{out.stem}_skills.csv")


def write_data(runs: list[Run], out: Path) -> None:
    """Write the tidy tables of curves and skills as CSV files."""
    curves = [{"run": run.label} | row for run in runs for row in curve_rows(run.records)]
    skills = [
        {"run": run.label, "seed": seed.index, "env_steps": seed.study.env_steps} | row
        for run in runs
        for seed in run.seeds
        for row in table(seed.study, name_actions(seed.trained.env))
    ]
    for path, rows in zip(data_paths(out), (curves, skills)):
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(rows[0]) if rows else ["run"])
            writer.writeheader()
            writer.writerows(rows)
