"""Flights from runs, policies, recorded states, best known laps, flight logs and JSON."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import check_file, read_json, read_npz
from quadjax.core.folders import kind_of
from quadjax.core.resources import find_policy
from quadjax.core.sections import build
from quadjax.evaluation.evaluation import Evaluation, evaluate
from quadjax.evaluation.recording import SIGNALS, STATES
from quadjax.evaluation.viewing import RATES, flights_of, marker_of, split
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.flight_log import FlightLog, read_log
from quadjax.policy.file import FORMATS, Policy
from quadjax.policy.race import policy_path, race_of_policy
from quadjax.race.recorded_starts import LIMIT
from quadjax.race.track import GateSection
from quadjax.studies.flight_files import (
    STATE_ARRAYS,
    flying_part,
    log_passages,
    recording_of_log,
    recordings_of_states,
    target_of,
)
from quadjax.vehicle.protocol import Signal
from quadjax.vehicle.registry import MODELS
from quadjax.view.data import FORMAT, Scene, check_record, flight_record, gate_record
from quadjax.view.flight import MOTORS, Flight, Marker, passages, passages_at, strip

RECORDED = (*STATE_ARRAYS, "target", "leg_times")


@dataclasses.dataclass(frozen=True)
class Options:
    """How sources are read.

    Attributes:
        race: that policies fly, and whose gates files without gates get; None: a policy's own.
        laps: of policies; ``evaluate.laps`` of the race if not given.
        runs: of each policy.
        sampled: sampled actions rather than the mean action.
        seed: of the noise and the disturbances.
        logs: columns and frames of flight logs.
        progress: called with the policy that is simulated.
        report: called with a line of text for a policy that flies the race of a preset.
    """

    race: Config | None = None
    laps: int | None = None
    runs: int = 1
    sampled: bool = False
    seed: int = 0
    logs: LogsConfig = dataclasses.field(default_factory=LogsConfig)
    progress: Callable[[str], None] = lambda line: None
    report: Callable[[str], None] = lambda line: None


@dataclasses.dataclass(frozen=True)
class Source:
    """Data of one source: flights or lap times, and their gates, if it contains them."""

    gates: tuple[GateSection, ...]
    flights: tuple[Flight, ...] = ()
    markers: tuple[Marker, ...] = ()
    record: dict[str, Any] | None = None  # of a file of records


def read_source(source: Path | str, name: str, options: Options) -> Source:
    """Flights of one source.

    Args:
        source: a training run's folder; a policy file, or the name of one that comes with the
            package; recorded states (``.npz``, of ``quadjax evaluate --states``); a best known lap
            (``.npz``, of ``quadjax limit --npz``); a flight log (``.csv``, ``.ulg``); records or
            lap times (``.json``).
        name: of the flights.
        options: how they are read.

    Raises:
        InputError: no such file, an unknown kind, or one that cannot be read.
    """
    path = Path(source)
    if path.is_dir() and policy_path(path) == path:
        path = find_policy(source)
    if path.is_dir():
        return _read_run(path, name, options)
    path = find_policy(path)
    check_file(path)
    readers = {".npz": _read_npz, ".csv": _read_log, ".json": _read_json, ".ulg": _read_log}
    if path.suffix not in readers:
        raise InputError(
            f"{source}: suffix is {path.suffix!r}, allowed: a run's folder, {', '.join(readers)}"
        )
    return readers[path.suffix](path, name, options)


def _read_run(folder: Path, name: str, options: Options) -> Source:
    policy, kind = policy_path(folder), kind_of(folder)
    if policy == folder:
        raise InputError(f"{folder}: no policy.npz, expected the folder of a training run")
    if kind not in (None, "training"):
        raise InputError(f"{folder}: holds files of {kind}, expected the folder of a training run")
    return fly(policy, name, options)


def _read_npz(path: Path, name: str, options: Options) -> Source:
    arrays, meta = read_npz(path, (*FORMATS, STATES, LIMIT), RECORDED)
    if meta["format"] in FORMATS:
        return fly(path, name, options)
    gates = tuple(_gates_of(path, meta)) or _gates(options)
    flights = _limit if meta["format"] == LIMIT else _states
    return Source(gates, tuple(flights(path, arrays, meta, gates, name)))


def fly(path: Path, name: str, options: Options) -> Source:
    """Flights of a policy file in its race, or in that of the options."""
    options.progress(f"simulating {path}")
    policy = Policy.load(path)
    race, _ = race_of_policy(policy, path, options.race, report=options.report)
    evaluation = evaluate(
        policy,
        race,
        runs=options.runs,
        laps=options.laps,
        deterministic=not options.sampled,
        seed=options.seed,
        name=str(path),
    )
    return of_evaluation(evaluation, name)


def of_evaluation(evaluation: Evaluation, name: str) -> Source:
    """Flights of an evaluation, and published lap times where it is the paper's race."""
    markers = tuple(marker_of(row) for row in evaluation.published)
    return Source(tuple(evaluation.gates), tuple(flights_of(evaluation, name)), markers)


def _gates(options: Options) -> tuple[GateSection, ...]:
    return tuple(options.race.track.gates) if options.race else ()


def _gates_of(path: Path, meta: dict[str, Any]) -> list[GateSection]:
    gates = meta.get("track") or []
    if not isinstance(gates, list):
        raise InputError(f"{path}: track is {gates!r:.80}, expected a list")
    return [build(GateSection, each, f"{path}: track[{index}]") for index, each in enumerate(gates)]


def _states(
    path: Path,
    arrays: dict[str, np.ndarray],
    meta: dict[str, Any],
    gates: tuple[GateSection, ...],
    name: str,
) -> list[Flight]:
    """Flights of ``Evaluation.save_states``."""
    recordings = recordings_of_states(path, arrays, meta, gates)
    flights = []
    for run, each in enumerate(recordings):
        label = name if len(recordings) == 1 else f"{name} {run + 1}"
        own = {key: getattr(each, key) for key in SIGNALS}
        flight = _flight(each.time, own, meta, label)
        passed = passages(each.time, each.position, gates, each.target)
        flights.append(
            dataclasses.replace(flight, passages=passed, lap_ends=each.lap_ends, crash=each.crash)
        )
    return flights


def _limit(
    path: Path,
    arrays: dict[str, np.ndarray],
    meta: dict[str, Any],
    gates: tuple[GateSection, ...],
    name: str,
) -> list[Flight]:
    """The flight of ``quadjax limit --npz``."""
    missing = [key for key in SIGNALS if key not in arrays]
    if missing:
        raise InputError(f"{path}: no array {missing[0]}")
    if not gates or "leg_times" not in arrays:
        raise InputError(f"{path}: a best known lap without gates or leg_times")
    periodic = meta.get("start") == "periodic"
    note = "best known lap, flying start" if periodic else "best known flight from hover"
    flight = _flight(arrays["time"], arrays, meta, name)
    when = np.cumsum(arrays["leg_times"])
    ends = when[len(gates) - 1 :: len(gates)]
    passed = passages_at(flight.time, flight.position, gates, when)
    return [
        dataclasses.replace(flight, passages=passed, lap_ends=ends, note=note, periodic=periodic)
    ]


def _flight(
    time: np.ndarray,
    arrays: dict[str, np.ndarray],
    meta: dict[str, Any],
    name: str,
) -> Flight:
    vehicle = MODELS.get(str(meta.get("vehicle")))  # code that a file names is not imported
    commands, actuators = arrays["command"], arrays["actuators"]
    own = (
        (vehicle.commands, (vehicle.actuators,))
        if vehicle
        else (
            (Signal("values", commands.shape[1], ""),),
            (Signal("actuators", actuators.shape[1], ""),),
        )
    )
    return Flight(
        name,
        time,
        arrays["position"],
        arrays["velocity"],
        Rotation.from_euler("ZYX", arrays["euler"][:, ::-1]),
        (
            *split(own[0], commands, "commanded "),
            *split(own[1], actuators, ""),
            strip("body rates", "rad/s", RATES, arrays["rates"]),
        ),
    )


def _read_log(path: Path, name: str, options: Options) -> Source:
    log, gates = read_log(path, options.logs), _gates(options)
    if log.position is None or log.attitude is None:
        raise InputError(f"{path}: position and attitude are needed to show a flight log")
    closed = options.race is None or options.race.track.closed
    return Source(gates, (flight_of_log(log, gates, name, closed),))


def flight_of_log(
    log: FlightLog, gates: tuple[GateSection, ...], name: str, closed: bool = True
) -> Flight:
    """The flying part of a flight log; a lap ends with the last gate."""
    part = flying_part(log) if log.flying.any() else slice(None)
    flown = recording_of_log(log, part)
    strips = [strip("rotor speed", "rpm", MOTORS, flown.actuators)] if log.speeds_measured else []
    if log.motor_command is not None:
        strips.insert(0, strip("motor command", "", MOTORS, log.motor_command[part]))
    if log.rpm_command is not None:
        strips.insert(0, strip("commanded rotor speed", "rpm", MOTORS, flown.command))
    strips.append(strip("body rates", "rad/s", RATES, flown.rates))
    samples = log_passages(flown.position, flown.velocity, gates, closed)
    target = target_of(len(flown.time), samples, gates)
    passed = passages(flown.time, flown.position, gates, target)
    return Flight(
        name,
        flown.time,
        flown.position,
        flown.velocity,
        Rotation.from_euler("ZYX", flown.euler[:, ::-1]),
        tuple(strips),
        passed,
        passed[passed[:, 1] == len(gates) - 1, 0],
        note="flight log",
    )


def _read_json(path: Path, name: str, options: Options) -> Source:
    value = read_json(path)
    if "format" in value:
        return Source((), record=check_record(path, value))
    if "best_known" in value and value.get("start") == "periodic":
        return Source((), markers=(Marker(name, np.array([float(value["best_known"])])),))
    laps = value.get("laps")
    try:
        rows = [np.array(row, np.float64) for row in laps] if isinstance(laps, list) else []
    except (TypeError, ValueError):
        rows = []
    whole = [row for row in rows if row.ndim == 1 and len(row) and np.isfinite(row).all()]
    if not whole:
        raise InputError(
            f"{path}: expected format {FORMAT}, or laps: lists of times of complete runs"
        )
    best = min(whole, key=lambda row: float(row.sum()))
    return Source((), markers=(Marker(name, np.cumsum(best)),))


def scene_record(
    sources: list[Path | str],
    names: list[str],
    title: str,
    options: Options,
) -> dict[str, Any]:
    """The record of a page with all sources; periodic laps are repeated to match the other flights.

    Args:
        sources: as for ``read_source``.
        names: of the first of them; the others are named after their files.
        title: of the page.
        options: how they are read.

    Raises:
        InputError: as ``read_source``; no flight; or flights on different tracks.
    """
    labels = [*names, *(_label(source) for source in sources[len(names) :])]
    read = [read_source(*each, options) for each in zip(sources, labels, strict=True)]
    gates: list[dict[str, Any]] = []
    for source, each in zip(sources, read, strict=True):
        own = each.record["gates"] if each.record else [gate_record(g) for g in each.gates]
        if gates and own and own != gates:
            raise InputError(f"{source}: is on another track than {sources[0]}")
        gates = gates or own
    laps = max((len(f.lap_ends) for each in read for f in each.flights), default=1)
    first = next((each.record for each in read if each.record), {})
    drone = first.get("drone") or Scene("", (), ()).drone()
    flights: list[dict[str, Any]] = []
    markers: dict[str, dict[str, Any]] = {}
    for each in read:
        flights += each.record["flights"] if each.record else []
        flights += [flight_record(flight.repeated(laps)) for flight in each.flights]
        markers |= {one["name"]: one for one in (each.record or {}).get("markers", [])}
        markers |= {one.name: one.record() for one in each.markers}
    if not flights:
        raise InputError("no flight to show, only lap times")
    whole = {"format": FORMAT, "title": title, "gates": gates, "drone": drone}
    return whole | {"flights": flights, "markers": list(markers.values())}


def _label(source: Path | str) -> str:
    path = Path(source)
    return path.resolve().name if path.is_dir() else path.stem
