"""Flights of a report, read from files: trajectories of an evaluation, or flight logs."""

import dataclasses
import glob
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadjax.config.schema import Track
from quadjax.core.errors import InputError
from quadjax.core.files import read_npz
from quadjax.evaluation.recording import STATES, Recording
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.flight_log import read_log
from quadjax.fitting.log_formats import FORMATS
from quadjax.studies.flight_files import (
    STATE_ARRAYS,
    ends_in,
    flying_part,
    recording_of_log,
    recordings_of_states,
)

RPM, RATES = "rpm", "rates"  # what a flight's commands are
MOST_FILES = 1000


@dataclasses.dataclass(frozen=True)
class Flight:
    """One flight of a report.

    Attributes:
        group: what it is compared with: its policy and where it flew.
        name: of the flight within its group.
        recording: its trajectory; time 0 is the start.
        gate_times: (passed,) time of each gate passage, s.
        commands: "rpm", "rates" (body rates and thrust), or "" where unknown.
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


def passages(position: np.ndarray, track: Track, reach: float = 0.0) -> tuple[list[int], list[int]]:
    """Samples at which a path is past the gates in turn, and the gate ahead at each sample.

    Args:
        position: (n, 3) m, world.
        track: the gates in order of passage.
        reach: m by which openings are wider: for positions that were measured.

    Returns:
        Index of the first sample past each passed gate, and the target (n,).
    """
    center = np.array([gate.position for gate in track.gates])
    axes = np.array([gate.axes for gate in track.gates])
    half = 0.5 * np.array([gate.size for gate in track.gates]) + reach
    samples: list[int] = []
    target, targets = 0, [0]
    for index in range(1, len(position)):
        before, after = (position[i] - center[target] for i in (index - 1, index))
        before, after = before @ axes[target], after @ axes[target]
        inside = abs(after[1]) <= half[target, 0] and abs(after[2]) <= half[target, 1]
        if before[0] < 0 <= after[0] and inside:
            samples.append(index)
            target = (target + 1) % len(center)
            if not track.closed and target == 0:
                break
        targets.append(target)
    return samples, targets + [target] * (len(position) - len(targets))


def make_flight(
    group: str, name: str, recording: Recording, track: Track, commands: str, reach: float = 0.0
) -> Flight:
    """A flight with its gate passages; those at a lap's end are at the recorded ends."""
    samples, _ = passages(recording.position, track, reach)
    times, gates = list(recording.time[samples]), len(track.gates)
    if recording.lap_ends.size * gates == len(times) + 1:  # it ends in the last gate
        times.append(recording.lap_ends[-1])
    return Flight(group, name, recording, np.array(times), commands)


def read_flights(path: Path, group: str, track: Track, logs: LogsConfig | None) -> list[Flight]:
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


def _simulated(path: Path, group: str, track: Track) -> list[Flight]:
    arrays, meta = read_npz(path, STATES, STATE_ARRAYS)
    recordings = recordings_of_states(path, arrays, meta)
    if arrays["lap_times"].shape[1] * len(track.gates) == 0:
        raise InputError(f"{path}: no laps")
    commands = RPM if arrays["actuators"].shape[2] == 4 else RATES
    flights = []
    for run, recording in enumerate(recordings):
        _, target = passages(recording.position, track)
        recording = dataclasses.replace(recording, target=np.array(target))
        flights.append(make_flight(group, f"{run + 1}", recording, track, commands))
    return flights


def _logged(path: Path, group: str, track: Track, logs: LogsConfig | None) -> Flight:
    """A flight log, from the first to the last sample in flight."""
    log = read_log(path, logs or _format(path))
    if log.position is None:
        raise InputError(f"{path}: no columns for position (logs.columns.position)")
    part = flying_part(log)
    if part.stop == 0:
        raise InputError(f"{path}: no sample in flight (logs.columns.mode)")
    recording = recording_of_log(log, part)
    samples, target = passages(recording.position, track, reach=0.1)
    if not samples:
        raise InputError(f"{path}: passes no gate of the track {track.name}, name its --race")
    if ends_in(recording, track.gates[target[-1]]):
        samples.append(len(target) - 1)
    ends = recording.time[samples][len(track.gates) - 1 :: len(track.gates)]
    if ends.size:  # laps that were completed; what comes after them is the landing
        last = int(np.searchsorted(recording.time, ends[-1])) + 1
        target = target[:last]
        recording = recording_of_log(log, slice(part.start, part.start + last))
    recording = dataclasses.replace(
        recording, target=np.array(target), lap_ends=ends, crash="" if ends.size else "no lap"
    )
    commands = "" if log.rpm_command is None else RPM
    return make_flight(group, path.stem, recording, track, commands, reach=0.1)


def _format(path: Path) -> LogsConfig:
    """The format whose columns a log has."""
    for name, form in FORMATS.items():
        columns = form.columns["time"] + form.columns["gyro"]
        if form.read is None and set(columns) <= set(form.header(path)):
            # Nothing is fitted: commands at a limit, of unclear scale, do not matter.
            return LogsConfig(format=name, max_scale_error=1e6)
    raise InputError(f"{path}: columns of no known format, allowed: --logs with a fit config")


def find_flights(
    words: Sequence[str], track: Track, logs: LogsConfig | None = None
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
