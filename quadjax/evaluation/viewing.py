"""Recorded flights as scenes of the 3D viewer."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.evaluation.figures import flight_title
from quadjax.evaluation.recording import Recording, distinct
from quadjax.evaluation.tables import Row
from quadjax.race.track import GateSection
from quadjax.vehicle.protocol import Signal, VehicleModel
from quadjax.view.data import Scene
from quadjax.view.flight import MOTORS, Flight, Marker, Strip, passages, strip

if TYPE_CHECKING:
    from quadjax.evaluation.evaluation import Evaluation

RATES = ("p, roll", "q, pitch", "r, yaw")


def flights_of(evaluation: "Evaluation", name: str) -> list[Flight]:
    """The distinct runs of an evaluation; several are numbered."""
    runs = distinct(evaluation.flights)
    names = [name] if len(runs) == 1 else [f"{name} {run + 1}" for run in range(len(runs))]
    actions = "deterministic" if evaluation.deterministic else "sampled"
    return [
        flight_of(run, evaluation.model, evaluation.gates, own, f"{flight_title(run)}, {actions}")
        for run, own in zip(runs, names, strict=True)
    ]


def scene_of(evaluation: "Evaluation", title: str) -> Scene:
    """The runs of an evaluation, with the published lap times of the same race."""
    flights = tuple(flights_of(evaluation, "run"))
    markers = tuple(marker_of(row) for row in evaluation.published)
    return Scene(title, tuple(evaluation.gates), flights, markers)


def flight_of(
    recording: Recording,
    model: VehicleModel,
    gates: Sequence[GateSection],
    name: str,
    note: str = "",
) -> Flight:
    """A recorded run as a flight of the viewer.

    Args:
        recording: the run.
        model: of its vehicle, which names commands and actuators.
        gates: of the track, in order of passage.
        name: shown next to the drone.
        note: one line about the flight.
    """
    attitude = Rotation.from_euler("ZYX", recording.euler[:, ::-1])
    commands = split(model.commands, recording.command, "commanded ")
    actuators = split((model.actuators,), recording.actuators, "")
    rates = strip("body rates", "rad/s", RATES, recording.rates)
    return Flight(
        name,
        recording.time,
        recording.position,
        recording.velocity,
        attitude,
        (*commands, *actuators, rates),
        passages(recording.time, recording.position, gates, recording.target),
        recording.lap_ends,
        recording.crash,
        note,
    )


def split(signals: Sequence[Signal], values: np.ndarray, prefix: str) -> list[Strip]:
    """The columns (n, k) of commands or actuators as strips, one for each signal of a model."""
    ends = np.cumsum([signal.size for signal in signals])[:-1]
    return [
        strip(title_of(signal, prefix), signal.unit, labels_of(signal), own)
        for signal, own in zip(signals, np.split(values, ends, axis=1), strict=True)
    ]


def title_of(signal: Signal, prefix: str) -> str:
    """The name of a signal in words; one that is called a command has no prefix."""
    words = {"rpm": "rotor speed"}.get(signal.name, signal.name.replace("_", " "))
    return words if "command" in words else prefix + words


def labels_of(signal: Signal) -> tuple[str, ...]:
    """Labels of the columns of a signal: motors for four, axes for three."""
    if signal.size == 4:
        return MOTORS
    if signal.size == 3:
        return RATES
    return (
        (signal.name,)
        if signal.size == 1
        else tuple(str(index + 1) for index in range(signal.size))
    )


def marker_of(row: Row) -> Marker:
    """A published line of a lap table as ends of laps."""
    return Marker(row.label, np.cumsum(row.laps))
