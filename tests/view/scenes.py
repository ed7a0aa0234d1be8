"""Scenes for tests: drones on circles through four gates, without a simulator."""

import numpy as np

from quadjax.flights import Flight, passages
from quadjax.flights.flight import motion_signals, vehicle_signals
from quadjax.race.track import GateSection
from quadjax.vehicle.registry import MODELS
from quadjax.view.data import page_record

RADIUS, HEIGHT, STEP = 3.0, 1.5, 0.01  # m, m, s
AHEAD = 0.2  # rad, where a flight starts, after the last gate
GATES = tuple(
    GateSection(
        position=(RADIUS * np.cos(angle), RADIUS * np.sin(angle), -HEIGHT),
        yaw_deg=np.degrees(angle) + 90.0,
        size=(1.2, 0.9),
        shape=shape,
        **more,
    )
    for angle, shape, more in (
        (np.pi / 2, "rectangle", {}),
        (np.pi, "rectangle", {"roll_deg": 30.0}),
        (3 * np.pi / 2, "rectangle", {"pitch_deg": 20.0}),
        (0.0, "circle", {}),
    )
)


def circle(name: str, lap: float = 3.0, laps: int = 2, offset: float = 0.0, **more) -> Flight:
    """A flight of laps of the same duration, ``offset`` m outside the gates' centers."""
    time = STEP * np.arange(int(round(laps * lap / STEP)) + 1)
    angle, rate, radius = 2 * np.pi * time / lap + AHEAD, 2 * np.pi / lap, RADIUS + offset
    cosine, sine, flat = np.cos(angle), np.sin(angle), 0.0 * time
    motion = {
        "position": np.stack([radius * cosine, radius * sine, flat - HEIGHT], axis=1),
        "velocity": radius * rate * np.stack([-sine, cosine, flat], axis=1),
        "attitude": np.stack([0.5 * np.sin(angle), flat + 0.3, angle + np.pi / 2], axis=1),
        "rates": np.zeros((len(time), 3)),
    }
    rpm = 9000.0 + 500.0 * np.sin(angle[:, None] + np.arange(4.0))
    flight = Flight(
        name,
        time,
        motion_signals(motion) | vehicle_signals(MODELS["motor"], rpm + 100.0, rpm),
        GATES,
        passages(time, motion["position"], GATES, cut=False),
        lap * np.arange(1, laps + 1),
        source={"vehicle": "motor"},
    )
    return flight.replace(**more)


def scene(*flights: Flight, title: str = "Circle") -> dict:
    """The record of a page of flights through the gates."""
    return page_record(title, flights)
