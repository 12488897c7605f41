"""Live page: the report on loopback, made again while a run trains, and agents to drive.

Nothing is written, no file is served, and only this machine is answered.
"""

import logging
import socket
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs

from envs_jax.optional import require
from hmasd_jax.report.drive import Driver
from hmasd_jax.report.page import check_packages, gather_runs, render_page
from hmasd_jax.report.search_views import expand, view_searches
from hmasd_jax.runs.checkpoint import CheckpointError, latest_step
from hmasd_jax.runs.folder import RunError, checkpoint_folder, metrics_path, read_config, seeds_of
from hmasd_jax.search.study import is_search, read_search
from hmasd_jax.search.tables import count_states
from hmasd_jax.validation import ConfigError, parse_index

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request

LOOPBACK = "127.0.0.1"
WAITING = """<!DOCTYPE html><meta http-equiv="refresh" content="2"><meta name="viewport"
content="width=device-width"><meta name="color-scheme" content="light dark"><title>Report</title>
<body style="font-family: system-ui"><p>{}</p>"""
LOOK_EVERY = 2.0
"""Seconds between two looks for new records and checkpoints."""
LARGEST_FORM = 10_000
"""Bytes of a form that are used at most."""
EXPECTED = (RunError, CheckpointError, ConfigError)
"""Errors whose message is one line with the remedy."""


class LiveReport:
    """The newest page of runs, made again by a thread when their files have changed."""

    def __init__(self, runs: Sequence[Path], make: Callable[[str], str]) -> None:
        """Prepare a report.

        Args:
            runs: Folders of runs.
            make: Function from the version of the page to its HTML.
        """
        self._runs, self._make = [Path(run) for run in runs], make
        self.version: str = ""
        self._failed: str | None = None
        """Version that raised an error which no later look will mend."""
        self.page: str = WAITING.format("The report is being made. This page waits for it.")

    def look(self) -> bool:
        """Make the page again if files have changed; return whether that was done.

        An error is shown on the page. One that is not expected is also logged, and the page is not
        made from the same files again.
        """
        version = ""
        try:
            version = self._fingerprint()
            if version in (self.version, self._failed):
                return False
            page = self._make(version)
        except (*EXPECTED, OSError) as error:
            self._tell(str(error))
            self.version = ""  # The files may come back as they were.
            return False
        except Exception as error:
            if self._tell(one_line(error)):
                log_fault("the report cannot be made", error)
            self._failed = version
            return False
        self.version, self.page = version, page
        return True

    def _tell(self, reason: str) -> bool:
        """Show why there is no page; return False if that is already shown."""
        before = self.page
        self.page = WAITING.format(f"The report cannot be made: {escape(reason)}.")
        return self.page != before

    def watch(self) -> None:
        """Look again and again, for ever."""
        while True:
            self.look()
            time.sleep(LOOK_EVERY)

    def _fingerprint(self) -> str:
        """Return a text that changes with every new record and checkpoint."""
        searches = [read_search(run) for run in self._runs if is_search(run)]
        parts = [count_states(search) for search in searches]
        for run in expand(self._runs):
            for seed in seeds_of(run):
                metrics, folder = metrics_path(run, seed), checkpoint_folder(run, seed)
                size = metrics.stat().st_size if metrics.is_file() else 0
                parts.append(f"{seed}.{size}.{latest_step(folder) or 0}")
        return "-".join(parts) or "empty"


def make_app(live: LiveReport, make_driver: Callable[[], Driver]) -> "Starlette":
    """Build the web application."""
    from starlette.applications import Starlette
    from starlette.concurrency import run_in_threadpool
    from starlette.middleware import Middleware
    from starlette.middleware.trustedhost import TrustedHostMiddleware
    from starlette.responses import HTMLResponse, PlainTextResponse
    from starlette.routing import Route

    drivers: list[Driver] = []
    lock = threading.Lock()

    def drive(form: dict[str, list[str]] | None) -> tuple[str, int]:
        with lock:
            try:
                if not drivers:
                    drivers.append(make_driver())
                if form is not None:
                    answer_form(drivers[0], form)
                return drivers[0].show(), 200
            except EXPECTED as error:
                return f"error: {error}", 400
            except Exception as error:
                drivers.clear()  # It may have played half of a segment.
                log_fault("the agents cannot be driven", error)
                return f"error: {one_line(error)}; load this page again for a new episode", 500

    async def show_report(request: "Request") -> Any:
        return HTMLResponse(live.page)

    async def show_version(request: "Request") -> Any:
        return PlainTextResponse(live.version)

    async def show_drive(request: "Request") -> Any:
        form = None
        if request.method == "POST":
            body = await request.body()
            form = parse_qs(body[:LARGEST_FORM].decode(errors="replace"), keep_blank_values=True)
        text, status = await run_in_threadpool(drive, form)
        answer = HTMLResponse if status == 200 else PlainTextResponse
        return answer(text, status_code=status)

    return Starlette(
        routes=[
            Route("/", show_report),
            Route("/version", show_version),
            Route("/drive", show_drive, methods=["GET", "POST"]),
        ],
        # Other sites that resolve their name to this machine are not answered.
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=[LOOPBACK, "localhost"])],
    )


def log_fault(what: str, error: Exception) -> None:
    """Log an error that was not expected, with its traceback."""
    logging.getLogger(__name__).error("error: %s", what, exc_info=error)


def one_line(error: Exception) -> str:
    """Return type and message of an error that was not expected."""
    return f"{type(error).__name__}: {error}".splitlines()[0]


def answer_form(driver: Driver, form: dict[str, list[str]]) -> None:
    """Do what a form asks for.

    Raises:
        ConfigError: A skill is not a number or does not exist.
    """
    if form.get("act") == ["restart"]:
        driver.restart()
        return
    words = [form.get(f"skill{token}", [""])[0] for token in range(driver.num_tokens)]
    skills = [parse_index(word) if word else None for word in words]
    if any(word and skill is None for word, skill in zip(words, skills)):
        raise ConfigError(f"skills must be whole numbers, got {', '.join(w[:20] for w in words)}")
    driver.play(skills)


def bind(port: int) -> socket.socket:
    """Return a socket on loopback.

    Raises:
        RunError: The port is busy.
    """
    bound = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((LOOPBACK, port))
    except OSError as error:
        bound.close()
        reason = error.strerror or error
        raise RunError(f"cannot serve on port {port} ({reason}): choose another --port") from error
    return bound


def serve(
    runs: Sequence[Path],
    port: int = 8000,
    episodes: int = 100,
    num_seeds: int = 3,
    megabytes: float = 15.0,
    solved_at: float | None = None,
) -> None:
    """Serve the report of runs on loopback until interrupted.

    Args:
        runs: Folders of runs; the agents of the first can be driven.
        port: Port on 127.0.0.1.
        episodes: As in `write_report`.
        num_seeds: As in `write_report`.
        megabytes: As in `write_report`.
        solved_at: As in `write_report`.

    Raises:
        MissingPackageError: A package of the extra `serve` is not installed.
        RunError: A folder is not the folder of a run, or the port is busy.
    """
    check_packages()
    for package in ("starlette", "uvicorn"):
        require(package, "serve", "a live report")
    import uvicorn

    runs = [Path(run) for run in runs]
    for run in expand(runs):
        read_config(run)  # raises the errors
    bound = bind(port)

    def make(version: str) -> str:
        found = gather_runs(expand(runs), episodes, num_seeds, solved_at, iter)
        return render_page(found, megabytes, live=version, searches=view_searches(runs))

    live = LiveReport(runs, make)
    threading.Thread(target=live.watch, daemon=True).start()
    app = make_app(live, partial(_first_driver, expand(runs)[0]))
    print(f"http://{LOOPBACK}:{bound.getsockname()[1]} (Ctrl-C stops it)", flush=True)
    with bound:
        uvicorn.Server(uvicorn.Config(app, log_level="warning")).run(sockets=[bound])


def _first_driver(run: Path) -> Driver:
    """Return a driver of the first seed that has a checkpoint."""
    for seed in seeds_of(run):
        if latest_step(checkpoint_folder(run, seed)) is not None:
            return Driver(run, seed)
    raise RunError(f"{run} has no checkpoint to drive yet: wait for the first one")
