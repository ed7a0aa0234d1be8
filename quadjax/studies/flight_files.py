"""Trajectories in files: states of ``quadjax evaluate --states``, and flight logs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.core.errors import InputError
from quadjax.evaluation.recording import SIGNALS, Recording
from quadjax.fitting.flight_log import FlightLog
from quadjax.race.track import GateSection
from quadjax.view.flight import clearance

STATE_ARRAYS = ("time", *SIGNALS, "lap_times")
REACH = 0.1  # m by which the openings are wider for a log, whose positions are measured
LAST_SECONDS = 0.05  # a log may end so long before its last gate, whose passage ended the flight


def recordings_of_states(
    path: Path, arrays: dict[str, np.ndarray], meta: dict[str, Any], gates: Sequence[GateSection]
) -> list[Recording]:
    """The runs of a file of states, each cut at its end.

    Args:
        path: of the file, for messages.
        arrays: of the file, as ``Evaluation.save_states`` describes them.
        meta: of the file, with the reasons for which runs ended early.
        gates: of the track, which give the targets of an earlier version's file, without any.

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
        own = {name: arrays[name][run, :end] for name in SIGNALS}
        if "target" in arrays:
            target = arrays["target"][run, :end].astype(int)
        else:
            target = target_of(end, passages(own["position"], gates), gates)
        runs.append(
            Recording(
                arrays["time"][:end],
                **own,
                target=target,
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


def passages(
    position: np.ndarray, gates: Sequence[GateSection], reach: float = 0.0, closed: bool = True
) -> list[int]:
    """The first sample past each gate that a path passes, in the order of the track.

    Args:
        position: (n, 3) m, world.
        gates: in order of passage; none are passed if it is empty.
        reach: m by which openings are wider: for positions that were measured.
        closed: whether the first gate follows the last one.
    """
    samples: list[int] = []
    last = len(position) if closed else len(gates)
    ahead = [(position - np.array(g.position)) @ np.array(g.axes) for g in gates]
    while gates and len(samples) < last:
        number = len(samples) % len(gates)
        place, begin = ahead[number], samples[-1] if samples else 0
        crossed = (place[begin:-1, 0] < 0) & (place[begin + 1 :, 0] >= 0)
        inside = clearance(gates[number], place[begin + 1 :, 1:]) >= -reach
        (found,) = np.nonzero(crossed & inside)
        if not found.size:
            break
        samples.append(begin + 1 + int(found[0]))
    return samples


def log_passages(
    position: np.ndarray, velocity: np.ndarray, gates: Sequence[GateSection], closed: bool = True
) -> list[int]:
    """``passages`` of a flight log, whose flight may end at its last gate.

    The last sample passes the gate ahead if it is less than ``LAST_SECONDS`` before its plane.

    Args:
        position: (n, 3) m, world.
        velocity: (n, 3) m/s, world.
        gates: in order of passage.
        closed: whether the first gate follows the last one.
    """
    samples = passages(position, gates, REACH, closed)
    if not gates or (not closed and len(samples) == len(gates)):
        return samples
    gate = gates[len(samples) % len(gates)]
    place = (position[-1] - np.array(gate.position)) @ np.array(gate.axes)
    speed = float(velocity[-1] @ np.array(gate.axes)[:, 0])
    near = -LAST_SECONDS * speed <= place[0] < 0
    inside = clearance(gate, place[1:]) >= -REACH
    return [*samples, len(position) - 1] if near and inside else samples


def target_of(count: int, samples: Sequence[int], gates: Sequence[GateSection]) -> np.ndarray:
    """The gate ahead (count,) of each sample of a path that passes the gates at ``samples``."""
    passed = np.searchsorted(np.array(samples, int), np.arange(count), side="right")
    return passed % max(len(gates), 1)
