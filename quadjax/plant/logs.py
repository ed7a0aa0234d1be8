"""Flight logs of the stand-in plant, in the columns of Paparazzi's flight logger.

Position, velocity and attitude are the navigation filter's; gyro, propeller speeds and
accelerometer are as measured, and the accelerometer's bias is the estimated one. A log has a row
for every sample of the plant, at any ``control_rate``.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.fitting.columns import paparazzi_columns
from quadjax.fitting.flight_log import write_log
from quadjax.plant.config import PlantConfig
from quadjax.plant.flights import Flights, fly_plan, plan_flights, rows
from quadjax.policy.file import Policy


@dataclasses.dataclass(frozen=True)
class Logged:
    """A log that was written."""

    path: Path
    rows: int
    crash: str  # reason of an early end, "" for none


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
        "rpm": frames.estimated.rpm,
        "rpm_command": frames.rpm_command,
        "acceleration": frames.accelerometer,
        "acceleration_bias": frames.force_bias,
    }
    time = {"time": flights.step * np.arange(len(target)), "mode": np.ones(len(target))}
    own = {name: rows(flights, vector, run) for name, vector in vectors.items()}
    return time | own | {"target_gate": target}


def gate_centers(config: Config) -> np.ndarray:
    """Centers (gates, 3) of a config's track, m, world."""
    return np.array([gate.position for gate in config.track.gates], np.float64)


def write_logs(
    race: Config,
    plant: PlantConfig,
    policies: Sequence[Path | str],
    folder: Path,
    flights: int = 4,
    laps: int = 6,
    seed: int = 0,
    report: Callable[[str], None] = lambda line: None,
) -> list[Logged]:
    """Simulate policies on the plant and write each flight's log to ``folder/POLICY_RUN.csv``.

    Args:
        race: config of the race.
        plant: config of the plant.
        policies: policy files.
        folder: of the logs.
        flights: of each policy.
        laps: of each flight, from hover.
        seed: of batteries, gusts, sensors and the policies' noise.
        report: called with the progress.

    Raises:
        InputError: a policy that cannot be read or does not fit, or a flight that is not finite;
            then no log of that policy is written.
    """
    plant = plant.replace(control_rate=plant.sample_rate)
    written: list[Logged] = []
    for name in policies:
        report(f"{name}: compiling")
        plan = plan_flights(race, plant, Policy.load(name), str(name), laps, flights, flights)
        ended = fly_plan(
            plan, seed, lambda seconds, n=name: report(f"{n}: {seconds:.0f} s simulated")
        )
        logs = [log_quantities(ended, run, gate_centers(race)) for run in range(flights)]
        for run, log in enumerate(logs):
            if not all(np.isfinite(values).all() for values in log.values()):
                raise InputError(f"{name}: flight {run} is not finite")
        for run, log in enumerate(logs):
            path = folder / f"{Path(name).stem}_{run}.csv"
            write_log(path, paparazzi_columns(log))
            written.append(Logged(path, len(log["time"]), ended.laps.crashes[run]))
    return written
