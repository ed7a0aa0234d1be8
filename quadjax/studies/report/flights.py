"""Flights of a report, read from files: trajectories of an evaluation, or flight logs."""

import dataclasses
import glob
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.files import read_npz
from quadjax.evaluation.recording import STATES, Recording
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.flight_log import read_log
from quadjax.fitting.log_formats import FORMATS
from quadjax.race.track import TrackSection
from quadjax.studies.flight_files import (
    STATE_ARRAYS,
    flying_part,
    log_passages,
    recording_of_log,
    recordings_of_states,
    target_of,
)

RPM, RATES = "rpm", "rates"  # what a flight's commands are
KINDS = {"motor": RPM, "rate": RATES}  # by the name of the vehicle model
MOST_FILES = 1000


@dataclasses.dataclass(frozen=True)
class Flight:
    """One flight of a report.

    Attributes:
        group: what it is compared with: its policy and where it flew.
        name: of the flight within its group.
        recording: its trajectory; time 0 is the start.
        gate_times: (passed,) time of each gate passage, s.
        commands: "rpm", "rates" (body rates and thrust), or "" for others and where unknown.
    """

    group: str
    name: str
    recording: Recording
    gate_times: np.ndarray
    commands: str

    @property
    def lap_times(self) -> np.ndarray:
        """Lap times (completed laps,), s."""
        return np.diff(self.recording.lap_ends, prepend=0.0)

    @property
    def total(self) -> float:
        """Time of all completed laps, s; NaN where the flight ended early."""
        ends = self.recording.lap_ends
        return np.nan if self.recording.crash or not len(ends) else float(ends[-1])


def make_flight(group: str, name: str, recording: Recording, gates: int, commands: str) -> Flight:
    """A flight with its gate passages; those at a lap's end are at the recorded ends.

    Args:
        group: what it is compared with.
        name: of the flight.
        recording: its trajectory; the target changes at the first sample past a gate.
        gates: number of gates of the track.
        commands: see ``Flight``.
    """
    ends = recording.lap_ends
    (passed,) = np.nonzero(np.diff(recording.target))
    times = list(recording.time[passed + 1]) if gates > 1 else list(ends)
    if ends.size * gates == len(times) + 1:  # it ends in the last gate
        times.append(ends[-1])
    return Flight(group, name, recording, np.array(times), commands)


def read_flights(
    path: Path, group: str, track: TrackSection, logs: LogsConfig | None
) -> list[Flight]:
    """The flights of a file: ``.npz`` of ``evaluate --states``, or a flight log (``.csv``).

    Args:
        path: the file.
        group: of its flights.
        track: that was flown.
        logs: columns and units of a log; None: those of a known format, by the header.

    Raises:
        InputError: a file that cannot be read, or in which no gate is passed; in one line.
    """
    if path.suffix.lower() == ".npz":
        return _simulated(path, group, track)
    if path.suffix.lower() == ".csv":
        return [_logged(path, group, track, logs)]
    raise InputError(f"{path}: suffix is {path.suffix!r}, allowed: .npz, .csv")


def _simulated(path: Path, group: str, track: TrackSection) -> list[Flight]:
    arrays, meta = read_npz(path, STATES, (*STATE_ARRAYS, "target"))
    recordings = recordings_of_states(path, arrays, meta, track.gates)
    if arrays["lap_times"].shape[1] * len(track.gates) == 0:
        raise InputError(f"{path}: no laps")
    commands = KINDS.get(str(meta.get("vehicle")), "")
    return [
        make_flight(group, f"{run}", recording, len(track.gates), commands)
        for run, recording in enumerate(recordings, start=1)
    ]


def _logged(path: Path, group: str, track: TrackSection, logs: LogsConfig | None) -> Flight:
    """A flight log, from the first to the last sample in flight."""
    log = read_log(path, logs or _format(path))
    if log.position is None:
        raise InputError(f"{path}: no columns for position (logs.columns.position)")
    part = flying_part(log)
    if part.stop == 0:
        raise InputError(f"{path}: no sample in flight (logs.columns.mode)")
    flown = recording_of_log(log, part)
    samples = log_passages(flown.position, flown.velocity, track.gates, track.closed)
    if not samples:
        raise InputError(f"{path}: passes no gate of the track {track.name}, name its --race")
    ends = flown.time[samples][len(track.gates) - 1 :: len(track.gates)]
    if ends.size:  # laps that were completed; what comes after them is the landing
        last = int(np.searchsorted(flown.time, ends[-1])) + 1
        flown = recording_of_log(log, slice(part.start, part.start + last))
    target = target_of(len(flown.time), samples, track.gates)
    recording = dataclasses.replace(
        flown, target=target, lap_ends=ends, crash="" if ends.size else "no lap"
    )
    commands = "" if log.rpm_command is None else RPM
    return make_flight(group, path.stem, recording, len(track.gates), commands)


def _format(path: Path) -> LogsConfig:
    """The format whose columns a log has."""
    for name, form in FORMATS.items():
        columns = form.columns["time"] + form.columns["gyro"]
        if form.read is None and set(columns) <= set(form.header(path)):
            # Nothing is fitted: commands at a limit, of unclear scale, do not matter.
            return LogsConfig(format=name, max_scale_error=1e6)
    raise InputError(f"{path}: columns of no known format, allowed: --logs with a fit config")


def find_flights(
    words: Sequence[str], track: TrackSection, logs: LogsConfig | None = None
) -> dict[str, list[Flight]]:
    """The flights of ``LABEL=FILE`` words, by label.

    Args:
        words: files or glob patterns; without a label, that of a file is its stem. Several with one
            label are one group.
        track: that was flown.
        logs: columns and units of the logs.

    Raises:
        InputError: no such file, or one that cannot be read.
    """
    groups: dict[str, list[Flight]] = {}
    for word in words:
        label, equals, pattern = word.partition("=")
        label, pattern = (label.strip(), pattern) if equals else ("", word)
        if equals and not label:
            raise InputError(f"{word}: expected LABEL=FILE")
        paths = sorted(glob.glob(str(Path(pattern).expanduser()))) if pattern else []
        if not paths or len(paths) > MOST_FILES:
            raise InputError(f"{pattern or word}: {len(paths)} files, expected 1 to {MOST_FILES}")
        for path in paths:
            own = label or Path(path).stem
            groups.setdefault(own, []).extend(read_flights(Path(path), own, track, logs))
    return groups


def fastest(flights: Sequence[Flight]) -> Flight:
    """The flight with the most laps, and the fastest of those."""
    return min(flights, key=lambda f: (-len(f.recording.lap_ends), *_order(f)))


def _order(flight: Flight) -> tuple[float, float]:
    ends = flight.recording.lap_ends
    return (float(ends[-1]) if ends.size else np.inf, -float(flight.recording.time[-1]))
