"""Timed flights of a policy file on the stand-in plant."""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.quaternion import Quaternion
from quadjax.core.vectors import Rotors, Vec3
from quadjax.flights import flight as recorded
from quadjax.plant.flight import Frame, Plan, advance, begin
from quadjax.race import laps
from quadjax.race.laps import Laps
from quadjax.race.layout import Layout
from quadjax.race.track import GateSection
from quadjax.vehicle.protocol import VehicleModel
from quadjax.vehicle.rate import RateCommand

CHUNK_SECONDS = 1.0  # of flight between checks for the end
SAME_STEP = 1e-6  # relative difference of time steps that count as equal


@dataclasses.dataclass(frozen=True)
class Flights:
    """Flights that have ended.

    Attributes:
        laps: the timed result.
        frames: of the recorded runs: time first, runs last, NumPy arrays.
        step: s between frames.
    """

    laps: Laps
    frames: Frame
    step: float


def check_steps(layout: Layout, trained: float, step: float) -> None:
    """Check that a policy that observes earlier steps flies in steps of its training.

    Args:
        layout: of the policy.
        trained: time step of the training, s.
        step: of the control loop, s.

    Raises:
        InputError: a history or a last action, and another step.
    """
    if layout.counts_steps and abs(step / trained - 1.0) > SAME_STEP:
        raise InputError(
            f"the policy observes earlier steps of {trained:g} s, the drone's control steps are "
            f"{step:g} s: add control_rate={1.0 / trained:g}"
        )


def fly_plan(
    plan: Plan, seed: int = 0, report: Callable[[float], None] = lambda seconds: None
) -> Flights:
    """Fly until every drone has finished or crashed.

    Args:
        plan: the flights.
        seed: of batteries, gusts, sensors and the policy's noise.
        report: called with the simulated seconds.

    Raises:
        InputError: see ``check_steps``.
    """
    check_steps(plan.choices.layout, float(plan.race.rules.time_step), plan.step)
    start, key = jax.random.split(jax.random.key(seed))
    drones, frames = begin(plan, start), []
    chunk = max(1, round(CHUNK_SECONDS / plan.step))
    for number in range(-(-plan.limit // chunk)):
        drones, frame = advance(plan, chunk, drones, jax.random.fold_in(key, number))
        frames.append(jax.tree.map(np.asarray, frame))
        report(len(frames) * chunk * plan.step)
        if bool(jnp.all(drones.race.over)):
            break
    joined = jax.tree.map(lambda *parts: np.concatenate(parts), *frames)
    step, limit = float(plan.plant.step), plan.limit * plan.step
    return Flights(laps.laps_of(plan.choices, drones.race, step, limit), joined, plan.step)


def rows(
    flights: Flights, vector: Vec3 | Quaternion | Rotors | RateCommand, run: int
) -> np.ndarray:
    """Components (n, k) of a vector of the frames in one recorded run, until its end."""
    going = ~flights.frames.over[:, run]
    columns = [np.asarray(x)[going, run] for x in jax.tree.leaves(vector)]
    return np.stack(columns, axis=1).astype(np.float64)


def recorded_flights(
    flights: Flights, gates: Sequence[GateSection], model: VehicleModel
) -> list[recorded.Flight]:
    """The recorded runs by their true states, each cut at its end, numbered from 1.

    Args:
        flights: that have ended.
        gates: of the track, in order of passage.
        model: of the policy, whose commands and actuators they have.
    """
    frames, result = flights.frames, []
    for run in range(frames.over.shape[-1]):
        true, target = frames.true, np.asarray(frames.target)[~frames.over[:, run], run]
        values = {
            "position": rows(flights, true.position, run),
            "velocity": rows(flights, true.velocity, run),
            "attitude": rows(flights, true.euler, run),
            "rates": rows(flights, true.rates, run),
            "actuators": rows(flights, true.actuators, run),
            "command": rows(flights, frames.command, run),
            "target": target[:, None].astype(np.float64),
        }
        times, crash = flights.laps.lap_times[run], flights.laps.crashes[run]
        name = f"{run + 1}"
        result.append(
            recorded.simulated_flight(name, flights.step, values, gates, model, times, crash)
        )
    return result
