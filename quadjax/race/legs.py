"""The straight lines between the gates of a track."""

import numpy as np

from quadjax.race.track import TrackSection

AGAINST_COSINE = 0.01  # of the angle, beyond 90 deg, from which a leg is against a gate


def legs_of(track: TrackSection) -> np.ndarray:
    """The vector (gates, 3) to each gate from the one before it, or from a course's start, m."""
    places = np.array([gate.position for gate in track.gates])
    before = np.roll(places, 1, axis=0)
    if not track.closed and track.start is not None:
        before[0] = track.start.position
    return places - before


def against_legs(track: TrackSection) -> list[int]:
    """Numbers, from 1, of gates that are passed against the leg to them or from them."""
    legs, axes = legs_of(track), np.array([gate.axes for gate in track.gates])[:, :, 0]
    after = np.roll(legs, -1, axis=0)
    if not track.closed:
        after[-1] = axes[-1]
    off = [
        (leg * axes).sum(axis=1) < -AGAINST_COSINE * np.linalg.norm(leg, axis=1)
        for leg in (legs, after)
    ]
    return [int(index) + 1 for index in np.flatnonzero(off[0] | off[1])]


def against_text(track: TrackSection) -> str:
    """A line that names the gates that are passed against a leg, or nothing."""
    if not (against := against_legs(track)):
        return ""
    which = f"gate{'s' if len(against) > 1 else ''} {', '.join(map(str, against))}"
    return f"more than 90 deg off a leg to or from it: check yaw_deg of {which}"
