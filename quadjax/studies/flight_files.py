"""Trajectories in files: states of ``quadjax evaluate --states``, and flight logs."""

from pathlib import Path
from typing import Any

import numpy as np

from quadjax.config.schema import Gate
from quadjax.core.errors import InputError
from quadjax.evaluation.recording import SIGNALS, Recording
from quadjax.fitting.flight_log import FlightLog

STATE_ARRAYS = ("time", *SIGNALS, "lap_times")
LAST_SECONDS = 0.05  # a log may end so long before its last gate, whose passage ended the flight


def recordings_of_states(
    path: Path, arrays: dict[str, np.ndarray], meta: dict[str, Any]
) -> list[Recording]:
    """The runs of a file of states, each cut at its end; their targets are zero.

    Args:
        path: of the file, for messages.
        arrays: of the file, as ``Evaluation.save_states`` describes them.
        meta: of the file, with the reasons for which runs ended early.

    Raises:
        InputError: an array is missing.
    """
    for name in STATE_ARRAYS:
        if name not in arrays:
            raise InputError(f"{path}: no {name}, expected the file of evaluate --states")
    reasons = {each["run"]: each["reason"] for each in meta.get("crashes", [])}
    runs = []
    for run, laps in enumerate(arrays["lap_times"]):
        end = int(np.isfinite(arrays["position"][run, :, 0]).sum())
        runs.append(
            Recording(
                arrays["time"][:end],
                **{name: arrays[name][run, :end] for name in SIGNALS},
                target=np.zeros(end, int),
                lap_ends=np.cumsum(laps[np.isfinite(laps)]),
                crash=reasons.get(run, ""),
            )
        )
    return runs


def recording_of_log(log: FlightLog, part: slice) -> Recording:
    """A part of a flight log that has positions; targets are zero, and there are no ends of laps.

    Without an attitude the velocity is the derivative of the position, the Euler angles are NaN.
    Rotor speeds that were not measured are NaN.

    Args:
        log: of a flight.
        part: of its samples; time 0 is the first of them.
    """
    assert log.position is not None
    if log.attitude is None:
        velocity = np.gradient(log.position, log.time, axis=0)[part]
        euler = np.full_like(velocity, np.nan)
    else:
        attitude = log.attitude[part]
        velocity = attitude.apply(log.body_velocity[part])
        euler = attitude.as_euler("ZYX")[:, ::-1]
    nothing = np.full_like(log.rpm, np.nan)
    command = nothing if log.rpm_command is None else log.rpm_command
    return Recording(
        log.time[part] - log.time[part][0],
        position=log.position[part],
        velocity=velocity,
        euler=euler,
        rates=log.rates[part],
        actuators=(log.rpm if log.speeds_measured else nothing)[part],
        command=command[part],
        target=np.zeros(len(velocity), int),
        lap_ends=np.zeros(0),
        crash="",
    )


def flying_part(log: FlightLog) -> slice:
    """From the first to the last sample in flight; the empty slice if there is none."""
    (flying,) = np.nonzero(log.flying)
    return slice(int(flying[0]), int(flying[-1]) + 1) if len(flying) else slice(0, 0)


def ends_in(recording: Recording, gate: Gate) -> bool:
    """Whether a log ends in a gate: at its last speed it is there within ``LAST_SECONDS``."""
    axes = np.array(gate.axes)
    place = (recording.position[-1] - np.array(gate.position)) @ axes
    speed = float(recording.velocity[-1] @ axes[:, 0])
    near = np.abs(place[1:]) <= 0.5 * np.array(gate.size)
    return bool(near.all() and -LAST_SECONDS * speed <= place[0] < 0)
