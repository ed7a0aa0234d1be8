"""Flights of a policy on a plant and on several that are drawn, and their logs."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from quadjax.config.schema import Config, Vehicle
from quadjax.core.errors import InputError
from quadjax.core.precision import single_precision
from quadjax.evaluation.conditions import Conditions
from quadjax.evaluation.published import flown_row
from quadjax.evaluation.rows import Row
from quadjax.flights.flight import MOTORS, Flight, Signal
from quadjax.plant.config import PlantConfig
from quadjax.plant.flight import Plan
from quadjax.plant.flights import (
    PlantFlights,
    extract_rows,
    fly_plan,
    log_quantities,
    plan_race,
    race_config,
    recorded_flights,
)
from quadjax.policy.file import Policy
from quadjax.race.laps import Laps
from quadjax.vehicle.registry import base_model

MAX_RECORDED = 5  # flights of a plant that are recorded
MOTOR_COMMAND = "motor_command"  # signal of a flight on the plant: commanded rotor speeds, rpm


def fly_plants(
    policy: Policy, name: str, race: Config, plant: PlantConfig, label: str, protocol: Conditions
) -> Row:
    """Flights from hover on drones of a plant; the row records one of each of the first drones.

    These have their true states, and the signal ``MOTOR_COMMAND``. Every flight has its own noise
    of batteries, gusts and sensors, the same for every policy.

    Args:
        policy: the policy.
        name: of its file, for messages.
        race: its vehicle, with its residual, is the onboard model.
        plant: with its population, or the constants of its first drone.
        label: of the condition.
        protocol: number of drones and flights, laps and seed.

    Raises:
        InputError: a policy that does not fit, or a protocol that the plant does not have.
    """
    if protocol.start != "hover" or protocol.laps is None or protocol.tracks:
        raise InputError("plant: flights are of whole laps from hover, allowed: laps, start=hover")
    runs = protocol.runs or 1
    count = protocol.drones or math.gcd(runs, plant.size)
    plan = plan_race(
        race,
        plant,
        policy,
        name,
        lap_count=protocol.laps,
        runs=runs,
        recorded=MAX_RECORDED,
        deterministic=bool(protocol.deterministic),
        drones=count,
    )
    flown = fly_plan(plan, protocol.seed)

    def record() -> list[Flight]:
        result, constants = [], race_config(race, policy).vehicle.constants
        recorded = recorded_flights(flown, race.track.gates, base_model(policy.vehicle))
        for run, flight in enumerate(recorded):
            command = Signal(extract_rows(flown, flown.frames.rpm_command, run), "rpm", MOTORS)
            flight = flight.replace(signals=flight.signals | {MOTOR_COMMAND: command})
            result.append(flight.of_drone(constants))
        return result

    best, drone = race.evaluate.best_known_lap, race_config(race, policy)
    by_drone = flown.laps.ordered(np.arange(runs).reshape(-1, count).T.ravel())
    published = flown_row(drone, plant, protocol.laps)
    share = _limit_share(flown, drone.vehicle)
    return Row(name, by_drone, label, count, None, None, record, published, best, share)


def _limit_share(flown: PlantFlights, drone: Vehicle) -> float:
    """Share of the motor commands of the recorded flights that are at a limit of the drone."""
    constants, count = drone.with_model("motor").constants, flown.frames.over.shape[1]
    commands = [extract_rows(flown, flown.frames.rpm_command, run) for run in range(count)]
    command, low, high = np.concatenate(commands), constants["rpm_min"], constants["rpm_max"]
    return float(((command <= low + 1.0) | (command >= high - 1.0)).mean())


@single_precision
def write_logs(
    plan: Plan,
    name: str,
    folder: Path,
    seed: int = 0,
    report: Callable[[str], None] = lambda line: None,
) -> tuple[dict[Path, int], Laps]:
    """Simulate flights on the plant and write the log of each to ``folder/NAME_RUN.csv``.

    Args:
        plan: the flights; see ``plan_logs``.
        name: of the logs.
        folder: of the logs; it exists.
        seed: of batteries, gusts, sensors and the policy's noise.
        report: called with the progress.

    Returns:
        The number of rows by file, and the laps of the flights.

    Raises:
        InputError: a flight that is not finite; then no log is written.
    """
    from quadjax.fitting.flight_log import write_log
    from quadjax.fitting.formats import paparazzi_columns

    report(f"{name}: compiling")
    ended = fly_plan(plan, seed, lambda seconds: report(f"{name}: {seconds:.0f} s simulated"))
    gates = np.stack([np.asarray(x) for x in plan.race.track.position.components()], 1)
    logs = [log_quantities(ended, run, gates) for run in range(plan.recorded)]
    for run, log in enumerate(logs):
        if not all(np.isfinite(values).all() for values in log.values()):
            raise InputError(f"{name}: flight {run} is not finite")
    rows = {}
    for run, log in enumerate(logs):
        path = folder / f"{name}_{run}.csv"
        write_log(path, paparazzi_columns(log))
        rows[path] = len(log["time"])
    return rows, ended.laps
