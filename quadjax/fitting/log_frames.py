"""Frames of a flight log: body FRD and world NED."""

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from quadjax.fitting.config import LogsConfig

Quantities = dict[str, np.ndarray]
WORLD = ("world_velocity", "position")  # quantities in world axes
BODY = ("gyro", "rate_command", "acceleration", "acceleration_bias", "body_velocity")
FLIP = np.array([1.0, -1.0, -1.0])  # FLU <-> FRD
HALF_TURN = Rotation.from_quat([1.0, 0.0, 0.0, 0.0])  # the same as a rotation
ENU_TO_NED = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def to_standard_frames(given: Quantities, config: "LogsConfig") -> tuple[Quantities, "LogsConfig"]:
    """Vectors in body FRD and world NED, with body velocity; attitudes as quaternions.

    Args:
        given: quantities in the log's frames; attitudes are rotations.
        config: with the frames.

    Returns:
        The quantities, and the config with the frames that were found where it says auto.
    """
    result = dict(given)
    rotation = _rotation(given)
    force = given["acceleration"] - given.get("acceleration_bias", 0.0)
    if config.body_frame == "auto":
        config = config.replace(body_frame="FLU" if np.median(force[:, 2]) > 0.0 else "FRD")
    if config.world_frame == "auto":
        up = rotation is not None and rotation.apply(force)[:, 2].mean() > 0.0
        config = config.replace(world_frame="ENU" if up else "NED")
    if config.body_frame == "FLU":
        result |= {name: result[name] * FLIP for name in BODY if name in result}
    if rotation is None:
        return result, config
    rotation = to_standard_attitude(rotation, config)
    if config.world_frame == "ENU":
        result |= {name: ENU_TO_NED.apply(result[name]) for name in WORLD if name in result}
    attitude = rotation.as_quat()  # scalar last
    # Of the two quaternions of an attitude, the one nearer to that of the previous sample.
    nearer = np.sign((attitude[1:] * attitude[:-1]).sum(axis=1))
    attitude[1:] *= np.cumprod(np.where(nearer < 0.0, -1.0, 1.0))[:, None]
    result["quaternion"] = attitude
    if "body_velocity" not in result:
        result["body_velocity"] = rotation.inv().apply(result["world_velocity"])
    return result, config


def to_standard_attitude(rotation: Rotation, config: "LogsConfig") -> Rotation:
    """Rotations from body FRD to world NED, of those between the log's frames."""
    if config.body_frame == "FLU":
        rotation = rotation * HALF_TURN
    return ENU_TO_NED * rotation if config.world_frame == "ENU" else rotation


def axes_of_frames(config: "LogsConfig") -> tuple[np.ndarray, np.ndarray]:
    """Matrices (3, 3) from the log's world frame to NED and from body FRD to the log's."""
    world = ENU_TO_NED.as_matrix() if config.world_frame == "ENU" else np.eye(3)
    return world, np.diag(FLIP) if config.body_frame == "FLU" else np.eye(3)


def _rotation(given: Quantities) -> Rotation | None:
    """Rotations (n) from the log's body frame to its world frame; None without an attitude."""
    if "quaternion" in given:
        return Rotation.from_quat(given["quaternion"][:, [1, 2, 3, 0]])
    if "rotation" in given:
        return Rotation.from_matrix(given["rotation"].reshape(-1, 3, 3))
    return rotation_of_euler(given["euler"]) if "euler" in given else None


def rotation_of_euler(euler: np.ndarray) -> Rotation:
    """Body-to-world rotations ``Rz(psi) Ry(theta) Rx(phi)`` of angles (n, 3), rad."""
    return Rotation.from_euler("ZYX", euler[:, ::-1])
