"""Flights of any source: a training run, a policy, a file of flights, or a flight log."""

import glob
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import check_file, read_npz
from quadjax.core.folders import kind_of
from quadjax.core.resources import POLICY_FILE, find_policy, is_run, policy_names
from quadjax.evaluation.evaluate import evaluate
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.flight_log import read_log
from quadjax.fitting.formats import FORMATS as LOG_FORMATS
from quadjax.fitting.log_table import read_head
from quadjax.flights import files, gates
from quadjax.flights.flight import Flight
from quadjax.policy.file import FORMAT as POLICY_FORMAT
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy
from quadjax.race.track import TrackSection
from quadjax.training.result import is_finished

LOGS = (".csv", ".ulg")
SUFFIXES = (".npz", ".csv", ".json", ".ulg")
MAX_FILES = 1000  # of a group


def load_flights(
    source: Path | str,
    name: str | None = None,
    *,
    race: Config | None = None,
    logs: LogsConfig | None = None,
    progress: Callable[[str], None] = lambda line: None,
    **options: Any,
) -> list[Flight]:
    """Flights of one source.

    Args:
        source: a training run's folder, also while it trains; a policy file, or the name of one
            that comes with the package; a file that ``quadjax.flights.load`` reads; or a flight log
            (``.csv``, ``.ulg``).
        name: of the flights, several of which are numbered; if not given, that of the file or
            folder, or those in a file of flights.
        race: that policies fly, and whose gates logs pass; None: a policy's own.
        logs: columns and frames of flight logs; None: those of a known format, by the header.
        progress: called with the policy that is simulated.
        options: arguments of ``quadjax.evaluate`` for policies; one run of the mean action if not
            given.

    Raises:
        InputError: no such file, an unknown kind, or one that cannot be read.
    """
    path = Path(source)
    path = path if is_run(path) else find_policy(source)
    if not path.exists() or not str(source):
        allowed = f"the folder of a run, a file ({', '.join(SUFFIXES)}), or a shipped policy"
        names = ", ".join(policy_names())
        raise InputError(f"{source or repr(source)}: no such file, allowed: {allowed}: {names}")
    label = name or (path.resolve().name if path.is_dir() else path.stem)
    is_policy = path.is_dir()
    path = _policy_of_run(path) if is_policy else path
    check_file(path)
    if path.suffix not in SUFFIXES:
        allowed = f"a run's folder, {', '.join(SUFFIXES)}"
        raise InputError(f"{source}: suffix is {path.suffix!r}, allowed: {allowed}")
    if path.suffix == ".npz" and not is_policy:
        _, meta = read_npz(path, (POLICY_FORMAT, files.FORMAT))
        is_policy = meta["format"] == POLICY_FORMAT
    if is_policy:
        progress(f"simulating {path}")
        return fly(path, label, race, **options)
    if path.suffix in LOGS:
        return [load_log(path, label, logs, None if race is None else race.track)]
    return files.load(path, name or "")


def _policy_of_run(folder: Path) -> Path:
    """The best policy of a run, or, while it trains, the newest."""
    policy, kind = folder / POLICY_FILE, kind_of(folder)
    if not is_run(folder):
        raise InputError(f"{folder}: no {POLICY_FILE}, expected the folder of a training run")
    if kind not in (None, "training"):
        raise InputError(f"{folder}: holds files of {kind}, expected the folder of a training run")
    newest = folder / "policy_last.npz"
    return newest if newest.is_file() and not is_finished(folder) else policy


def fly(path: Path, name: str, race: Config | None = None, **options: Any) -> list[Flight]:
    """Flights of a policy file in its race, or in another one, and published lap times.

    The arguments are those of ``load_flights``.
    """
    policy = Policy.load(path, race)
    race, _ = race_of_policy(policy, path, race)
    arguments = {"runs": 1, "deterministic": True} | options
    return evaluate(policy, race, name=str(path), **arguments).named_flights(name)


def load_log(
    path: Path, name: str, logs: LogsConfig | None = None, track: TrackSection | None = None
) -> Flight:
    """The flying part of a flight log, with its passages of the gates; a lap ends with the last.

    Args:
        path: the log.
        name: of the flight.
        logs: columns and frames; None: those of a known format, by the header.
        track: that was flown; None: unknown.

    Raises:
        InputError: a log that cannot be read, without positions, or without a sample in flight.
    """
    flight = read_log(path, logs or _format_of(path)).airborne().replace(name=name)
    if np.isnan(flight["position"]).any():
        raise InputError(f"{path}: no columns for position (logs.columns.position)")
    if not len(flight.time):
        raise InputError(f"{path}: no sample in flight (logs.columns.mode)")
    if track is None:
        return flight
    return flight.with_passages(track.gates, gates.MEASURED_MARGIN_M, track.closed)


def _format_of(path: Path) -> LogsConfig:
    """The format whose columns a log has; plain columns for a log of several formats."""
    if path.suffix != ".csv":
        return LogsConfig(format="ulog")
    if files.is_table(path):
        raise InputError(
            f"{path}: a table of flights has no gates, allowed: the file of evaluate --states "
            "FILE.npz, or a flight log"
        )
    for name, form in LOG_FORMATS.items():
        columns = form.columns["time"] + form.columns["gyro"]
        if form.read is None and set(columns) <= set(read_head(path, form.settings)[0]):
            # Nothing is fitted: commands at a limit, of unclear scale, do not matter.
            return LogsConfig(format=name, max_scale_error=1e6)
    raise InputError(f"{path}: columns of no known format, allowed: --logs with a fit config")


def load_groups(
    arguments: Sequence[str], track: TrackSection, logs: LogsConfig | None = None
) -> dict[str, list[Flight]]:
    """Recorded flights of ``LABEL=FILE`` arguments, by label, each with at least one passage.

    Args:
        arguments: files or glob patterns; without a label, that of a file is its stem. Several
            with one label are one group.
        track: that was flown.
        logs: columns and units of the logs; None: those of a known format, by the header.

    Raises:
        InputError: no such file, or one that cannot be read.
    """
    groups: dict[str, list[Flight]] = {}
    for argument in arguments:
        label, equals, pattern = argument.partition("=")
        label, pattern = (label.strip(), pattern) if equals else ("", argument)
        if equals and not label:
            raise InputError(f"{argument}: expected LABEL=FILE")
        file = str(Path(pattern).expanduser())  # whose name may have the characters of a pattern
        paths = [file] if os.path.isfile(file) else sorted(glob.glob(file))
        if not pattern:
            raise InputError(f"{argument or repr(argument)}: expected LABEL=FILE")
        if not paths:
            raise InputError(f"{pattern}: no such file")
        if len(paths) > MAX_FILES:
            raise InputError(f"{pattern}: {len(paths)} files, expected 1 to {MAX_FILES}")
        for path in map(Path, paths):
            groups.setdefault(label or path.stem, []).extend(_recorded(path, track, logs))
    return groups


def _recorded(path: Path, track: TrackSection, logs: LogsConfig | None) -> list[Flight]:
    """The flights of a file, or of a log up to the end of its last lap."""
    if path.suffix.lower() == ".npz":
        flights = files.load(path)
        return [flight.replace(name=str(run)) for run, flight in enumerate(flights, start=1)]
    if path.suffix.lower() not in LOGS:
        raise InputError(f"{path}: suffix is {path.suffix!r}, allowed: .npz, {', '.join(LOGS)}")
    flight = load_log(path, path.stem, logs, track)
    if not len(flight.passages):
        raise InputError(f"{path}: passes no gate of the track {track.name}, name its --race")
    if not len(flight.lap_ends):
        return [flight.replace(crash="no lap")]
    return [flight.slice(slice(0, int(np.searchsorted(flight.time, flight.lap_ends[-1])) + 1))]
