"""Episodes of training that start in states of recorded flights."""

import jax
import numpy as np

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import check_finite
from quadjax.flights.files import load
from quadjax.flights.flight import MOTION, Flight
from quadjax.race.environment import RaceParams
from quadjax.race.starts import RecordedStarts, recorded_starts
from quadjax.vehicle.registry import model as vehicle_model

NAMES = (*MOTION, "actuators")


def read_starts(config: Config, params: RaceParams) -> RecordedStarts | None:
    """The states of ``run.start_states``; None without such a file.

    Every sample of the flights in the file is a state, with the gate ahead as its target. Of a lap
    that can be repeated the last sample, which is the first, is left out. Flights that lack a
    signal of a state are left out.

    Args:
        config: of the training.
        params: of the race, without these states.

    Raises:
        InputError: a file that cannot be read, or that is of another vehicle or track.
    """
    path = config.run.start_states
    if path is None:
        return None
    name = f"run.start_states: {path}"
    arrays = states_of(name, load(path, config.track.gates))
    model, gates = vehicle_model(config.vehicle.model), len(config.track.gates)
    size, target = arrays["actuators"].shape[1], arrays["target"]
    if size != model.actuators.size:
        raise InputError(
            f"{name} has {size} actuators, the config's vehicle has {model.actuators.size}"
        )
    if target.min() < 0 or target.max() >= gates:
        raise InputError(
            f"{name}: target is {int(target.min())} to {int(target.max())}, allowed: the track's "
            f"gates, 0 to {gates - 1}"
        )
    ends = model.actuator_range(params.vehicle.constants)
    if model.uses_start_thrust:
        ends = config.start.thrust
    low, high = (np.array(jax.tree.leaves(end), np.float64) for end in ends)
    scaled = 2.0 * (arrays["actuators"] - low) / (high - low) - 1.0
    motion = [arrays[key] for key in MOTION]
    return recorded_starts(motion, scaled, target, config.run.start_states_part)


def states_of(name: str, flights: list[Flight]) -> dict[str, np.ndarray]:
    """The states (n, k) of flights, by the names of the signals, and "target" (n,)."""
    for flight in flights:
        for key, signal in flight.signals.items():
            if key in NAMES:
                check_finite(name, key, signal.values)
    whole = [flight for flight in flights if set(NAMES) <= set(flight.signals)]
    if not whole:
        missing = [key for key in NAMES if not flights or key not in flights[0].signals]
        raise InputError(f"{name}: {missing[0]} is missing; expected {', '.join(NAMES)}")
    ends = [len(f.time) - bool(f.source.get("periodic")) for f in whole]
    arrays = {
        key: np.concatenate([f[key][:end] for f, end in zip(whole, ends, strict=True)])
        for key in NAMES
    }
    if not len(arrays["position"]):
        raise InputError(f"{name}: no state")
    angles = arrays["attitude"]
    within = np.remainder(angles + np.pi, 2.0 * np.pi) - np.pi
    arrays["attitude"] = np.where(np.abs(angles) > np.pi, within, angles)
    targets = [f.target[:end] for f, end in zip(whole, ends, strict=True)]
    return arrays | {"target": np.concatenate(targets)}
