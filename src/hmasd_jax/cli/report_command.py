"""The command `report`."""

from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from hmasd_jax.cli.hints import suggest_next
from hmasd_jax.cli.options import ReportOptions

Item = TypeVar("Item")


def report(options: ReportOptions) -> int:
    """Write or serve a report of runs and return the exit code."""
    settings = {
        "episodes": options.episodes,
        "num_seeds": options.seeds,
        "megabytes": options.megabytes,
        "solved_at": options.solved_at,
    }
    if options.serve:
        from hmasd_jax.report.serve import serve

        serve(options.runs, options.port, **settings)
        return 0
    from hmasd_jax.report.page import check_packages, count_tracked, write_report
    from hmasd_jax.report.search_views import expand

    check_packages()
    folders = expand(options.runs)
    total = sum(count_tracked(run, options.seeds) for run in folders)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True)) as progress:
        task = progress.add_task("playing and drawing skills", total=total)

        def track(items: Iterable[Item]) -> Iterator[Item]:
            for item in items:
                yield item
                progress.advance(task)

        out = write_report(options.runs, options.out, track=track, **settings)
    size = out.stat().st_size / 1e6
    print(f"{out} ({size:.1f} MB); open it in a browser")
    if size > options.megabytes:
        print(f"it is larger than {options.megabytes:g} MB: show fewer seeds with --seeds")
    suggest_next("render", folders[-1], "--out", "episode.gif")
    return 0
