"""What is true of one drone at one instant: what sensors measure and an estimator is judged by."""

from flax import struct

from quadjax.core.vectors import Rotors, Vec3


@struct.dataclass
class Truth:
    """The true motion of one drone."""

    position: Vec3  # m, world NED
    velocity: Vec3  # m/s, world NED
    euler: Vec3  # roll, pitch, yaw, rad
    rates: Vec3  # p, q, r, rad/s, body FRD
    specific_force: Vec3  # m/s^2, body FRD: an accelerometer's at the centre of gravity
    rpm: Rotors  # propeller speeds, rpm
