"""Show a training run or a sweep as a page in the browser, also while it trains.

The page has learning curves, causes of crashes and the newest policy's flights in 3D; of a sweep,
its trials and the best policy's flights. It is served on 127.0.0.1 at an unused port, to this
machine only, and reads the folder without changing it. Ctrl-C ends the server.
"""

import argparse
import contextlib
import functools
import os
import subprocess
import sys
import time
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quadjax.cli.arguments import Parser, count, parse
from quadjax.core.errors import InputError
from quadjax.core.interruptions import interruptions, loading

if TYPE_CHECKING:
    from quadjax.config.schema import Config
    from quadjax.dashboard.flyer import Flyer, Folder
    from quadjax.dashboard.server import Server

NICE = 19  # the lowest priority: a training's threads come first
POLL = 0.5  # s
LINGER = 60  # s from the last request until the server of a finished training ends


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("watch", description=__doc__)
    parser.add_argument("folder", type=Path, metavar="RUN", help="folder of a run or a sweep")
    parser.add_argument(
        "overrides", nargs="*", default=[], metavar="key=value", help="change keys of --race"
    )
    parser.add_argument(
        "--race", metavar="CONFIG", help="config of the run, if it names your own code"
    )
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    parser.add_argument(
        "--idle",
        type=count,
        metavar="S",
        help="end S seconds after the latest request, once the run is finished or has no process",
    )
    return parse(parser, argv)


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve the page until Ctrl-C."""
    options = _arguments(arguments)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.dashboard.flyer import Flyer
        from quadjax.dashboard.server import Document, Server

    if not options.folder.is_dir() and options.idle is None:
        raise InputError(f"{options.folder}: no such folder")
    if options.overrides and options.race is None:
        raise InputError(f"{options.overrides[0]}: overrides change --race, which is missing")
    race = load_config(options.race, options.overrides) if options.race else None
    parent = os.getppid()
    with contextlib.suppress(AttributeError, OSError):
        os.nice(NICE)
    if options.idle is not None:  # Linux weighs a session of its own as a group
        with contextlib.suppress(OSError):
            Path("/proc/self/autogroup").write_text(str(NICE))
    folder = _folder(options.folder, race)
    flyer = Flyer(folder, race)
    documents: dict[str, Document] = {
        "/state.json": functools.partial(_state, folder, flyer),
        "/flights.json": lambda: flyer.record,
    }
    server = Server(functools.partial(_page, folder), documents)
    print(server.url, flush=True)
    if options.open:
        webbrowser.open(server.url)
    with interruptions(b"\n") as stop:
        while not stop.wait(POLL) and not _idle(server, folder, options.idle, parent):
            pass
    server.close()
    if not flyer.close():  # a compilation, which the interpreter cannot end
        os._exit(0)
    return 0


def _folder(path: Path, race: "Config | None") -> "Folder":
    """The run or the sweep of a folder."""
    from quadjax.dashboard.run_state import TrainingRun
    from quadjax.dashboard.sweep_state import JOURNAL, SweepRun

    return SweepRun(path) if (path / JOURNAL).exists() else TrainingRun(path, race)


def _state(folder: "Folder", flyer: "Flyer") -> dict[str, Any]:
    """The data that the page requests every few seconds."""
    flights = {"flights": flyer.count, "causes": flyer.causes, "error": flyer.error}
    return folder.state() | flights | {"name": folder.name}


def _page(folder: "Folder") -> str:
    from quadjax.view.page import page

    return page({"live": folder.kind, "title": f"{folder.name} - quadjax"}, server=True)


def _idle(server: "Server", folder: "Folder", seconds: int | None, parent: int) -> bool:
    """Whether there are no more requests and nothing changes."""
    if seconds is None or time.monotonic() - server.asked < seconds:
        return False
    import psutil

    return folder.finished or not psutil.pid_exists(parent)


def start(folder: Path, race: Sequence[str] = ()) -> str:
    """Serve the page of a folder from a separate process; returns its address.

    The process ends by itself when the folder's run is over and the page sends no more requests.

    Args:
        folder: of a run.
        race: its config and overrides, if the config names code.
    """
    command = [sys.executable, "-m", "quadjax", "watch", str(folder), "--idle", str(LINGER)]
    command += [*race[1:], "--race", race[0]] if race else []
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
    )
    assert process.stdout is not None
    return process.stdout.readline().decode().strip()
