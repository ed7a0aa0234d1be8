"""Flight logs of the stand-in plant, in the columns of Paparazzi's flight logger.

Position, velocity and attitude are the navigation filter's; gyro, propeller speeds and
accelerometer are as measured, and the accelerometer's bias is the estimated one. A log has a row
for every sample of the plant, at any ``control_rate``.
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting.columns import paparazzi_columns
from quadjax.fitting.flight_log import write_log
from quadjax.plant.flights import Flights, Plan, fly_plan, rows
from quadjax.vehicle.rate import RateCommand


@dataclasses.dataclass(frozen=True)
class WrittenLog:
    """A log that was written."""

    path: Path
    rows: int
    crash: str  # reason of an early end, "" for none
    seconds: float  # of flight
    total: float  # s of all laps; NaN if it did not finish


def log_quantities(flights: Flights, run: int, gates: np.ndarray) -> dict[str, np.ndarray]:
    """One recorded run as quantities of a flight log, each (n,) or (n, k).

    Args:
        flights: that have ended.
        run: index of the recorded run.
        gates: (gates, 3) centers, m, world.
    """
    frames = flights.frames
    target = gates[np.asarray(frames.target)[~frames.over[:, run], run]]
    vectors = {
        "position": frames.estimated.position,
        "world_velocity": frames.estimated.velocity,
        "euler": frames.estimated.euler,
        "gyro": frames.gyro,
        "rpm": frames.estimated.actuators,
        "rpm_command": frames.rpm_command,
        "acceleration": frames.accelerometer,
        "acceleration_bias": frames.force_bias,
    }
    if isinstance(frames.command, RateCommand):
        vectors["rate_command"] = frames.command.rates
        vectors["thrust_command"] = frames.command.thrust
    time = {"time": flights.step * np.arange(len(target)), "mode": np.ones(len(target))}
    own = {name: rows(flights, vector, run) for name, vector in vectors.items()}
    return time | own | {"target_gate": target}


def write_logs(
    plans: Mapping[str, Plan],
    folder: Path,
    seed: int = 0,
    report: Callable[[str], None] = lambda line: None,
) -> list[WrittenLog]:
    """Simulate flights on the plant and write each flight's log to ``folder/NAME_RUN.csv``.

    Args:
        plans: flights by name, with a control step at every sample and all runs recorded.
        folder: of the logs.
        seed: of batteries, gusts, sensors and the policies' noise.
        report: called with the progress.

    Raises:
        InputError: a flight that is not finite; then no log of that name is written.
    """
    written: list[WrittenLog] = []
    for name, plan in plans.items():
        report(f"{name}: compiling")

        def show(seconds: float, name: str = name) -> None:
            report(f"{name}: {seconds:.0f} s simulated")

        ended = fly_plan(plan, seed, show)
        gates = np.stack([np.asarray(x) for x in plan.race.track.position.components()], 1)
        logs = [log_quantities(ended, run, gates) for run in range(plan.recorded)]
        for run, log in enumerate(logs):
            if not all(np.isfinite(values).all() for values in log.values()):
                raise InputError(f"{name}: flight {run} is not finite")
        for run, log in enumerate(logs):
            path = folder / f"{name}_{run}.csv"
            write_log(path, paparazzi_columns(log))
            laps = ended.laps
            result = laps.crashes[run], float(laps.seconds[run]), float(laps.totals[run])
            written.append(WrittenLog(path, len(log["time"]), *result))
    return written
