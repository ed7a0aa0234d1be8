"""Trajectories: distances from the gates' centers."""

import numpy as np

from quadjax.evaluation.recording import Recording, gate_offsets, state_arrays
from quadjax.race.track import GateSection

GATES = [
    GateSection(position=(2.0, 0.0, -1.5), yaw_deg=0.0),
    GateSection(position=(0.0, 2.0, -1.5), yaw_deg=90.0),
]


def flight(positions, targets):
    n, zeros = len(targets), np.zeros((len(targets), 3))
    return Recording(
        time=0.01 * np.arange(n),
        position=np.array(positions),
        velocity=zeros,
        euler=zeros,
        rates=zeros,
        actuators=np.zeros((n, 4)),
        command=np.zeros((n, 4)),
        target=np.array(targets),
        lap_ends=np.zeros(0),
        crash="",
    )


def test_an_offset_is_measured_where_the_plane_is_crossed():
    # Half-way between two samples 0.3 m to the right of the first gate and level with it, then a
    # quarter of the way 0.4 m below the second one's center and 0.1 m to the side.
    positions = [[1.9, 0.2, -1.5], [2.1, 0.4, -1.5], [0.1, 1.9, -1.1], [0.1, 2.3, -1.1]]
    found = gate_offsets(flight(positions, [0, 1, 1, 0]), GATES)
    np.testing.assert_allclose(found, [0.3, 0.4], atol=1e-6)
    assert gate_offsets(flight(positions, [0, 0, 0, 0]), GATES).size == 0


def test_states_have_the_targets_of_every_run():
    short, long = flight(np.zeros((2, 3)), [0, 1]), flight(np.zeros((3, 3)), [0, 1, 0])
    target = state_arrays([short, long])["target"]
    np.testing.assert_array_equal(target, [[0, 1, np.nan], [0, 1, 0]])
