"""Scenes for tests: drones on circles through four gates, without a simulator."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.race.track import GateSection
from quadjax.view.data import Scene
from quadjax.view.flight import MOTORS, Flight, Marker, passages, strip

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
    cosine, sine = np.cos(angle), np.sin(angle)
    position = np.stack([radius * cosine, radius * sine, -HEIGHT + 0.0 * time], axis=1)
    velocity = radius * rate * np.stack([-sine, cosine, 0.0 * time], axis=1)
    euler = np.stack([angle + np.pi / 2, 0.3 + 0.0 * angle, 0.5 * np.sin(angle)], axis=1)
    rpm = 9000.0 + 500.0 * np.sin(angle[:, None] + np.arange(4.0))
    strips = (
        strip("commanded rotor speed", "rpm", MOTORS, rpm + 100.0),
        strip("rotor speed", "rpm", MOTORS, rpm),
    )
    flight = Flight(
        name,
        time,
        position,
        velocity,
        Rotation.from_euler("ZYX", euler),
        strips,
        passages(time, position, GATES),
        lap * np.arange(1, laps + 1),
    )
    return dataclasses.replace(flight, **more)


def scene(*flights: Flight, title: str = "Circle", markers: tuple[Marker, ...] = ()) -> Scene:
    """Flights through the gates."""
    return Scene(title, GATES, flights, markers)
