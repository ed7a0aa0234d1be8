"""Flights on circles through the gates of a track, without a simulator."""

import numpy as np

from quadjax.flights import Flight
from quadjax.flights.flight import motion_signals, vehicle_signals
from quadjax.race.track import GateSection
from quadjax.vehicle.registry import MODELS

GATES = tuple(
    GateSection(position=(3.0 * np.sin(a), -3.0 * np.cos(a), -1.5), yaw_deg=np.degrees(a))
    for a in (0.0, np.pi)
)


def circle(name="one", lap=2.0, laps=2, model="motor", gates=GATES, ahead=0.3):
    """Laps of ``lap`` s, from ``ahead`` rad after the last of the gates, which are on a circle."""
    time = np.round(0.01 * np.arange(int(round(100 * lap * laps)) + 1), 9)
    x, y, z = gates[-1].position
    radius, rate = np.hypot(x, y), 2 * np.pi / lap
    angle = np.arctan2(y, x) + ahead + rate * time
    cosine, sine, flat = np.cos(angle), np.sin(angle), 0.0 * time
    yaw = np.remainder(angle + 1.5 * np.pi, 2 * np.pi) - np.pi
    motion = {
        "position": np.stack([radius * cosine, radius * sine, flat + z], axis=1),
        "velocity": radius * rate * np.stack([-sine, cosine, flat], axis=1),
        "attitude": np.stack([flat, flat + 0.2, yaw], axis=1),
        "rates": np.stack([flat, flat, flat + rate], axis=1),
    }
    sizes = (MODELS[model].action_size, MODELS[model].actuators.size)
    motors = (np.full((len(time), size), 8000.0) for size in sizes)
    signals = motion_signals(motion) | vehicle_signals(MODELS[model], *motors)
    return Flight(name, time, signals, source={"vehicle": model}).with_passages(gates)
