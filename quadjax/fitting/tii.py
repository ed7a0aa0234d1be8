"""Logs of the TII-RATM drone racing dataset (version 3): 500 Hz, motor commands, no rotor speeds.

The nine elements of the attitude's rotation matrix are in the order of rows or of columns: the one
whose change is the gyro's is taken.
"""

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

Quantities = dict[str, np.ndarray]
SPAN = 10  # samples, over which the attitude's change is compared with the gyro
COLUMNS = {
    "time": ["elapsed_time"],
    "motor_command": [f"thrust[{index}]" for index in (3, 1, 0, 2)],
    "gyro": [f"gyro_{axis}" for axis in "xyz"],
    "acceleration": [f"accel_{axis}" for axis in "xyz"],
    "world_velocity": [f"drone_velocity_linear_{axis}" for axis in "xyz"],
    "position": [f"drone_{axis}" for axis in "xyz"],
    "rotation": [f"drone_rot[{index}]" for index in range(9)],
}


def adjust(quantities: Quantities, _settings: Mapping[str, str]) -> Quantities:
    """The rotation matrix's elements in the order of its rows."""
    given = quantities.get("rotation")
    if given is None or len(given) <= 2 * SPAN:
        return quantities
    by_columns = given.reshape(-1, 3, 3).transpose(0, 2, 1).reshape(-1, 9)
    errors = [_error(matrix, quantities) for matrix in (given, by_columns)]
    return quantities | {"rotation": by_columns if errors[1] < errors[0] else given}


def _error(rotation: np.ndarray, quantities: Quantities) -> float:
    """Mean square of the gyro less the rotation's change, rad^2/s^2."""
    attitude = Rotation.from_matrix(rotation.reshape(-1, 3, 3))
    time = quantities["time"]
    seconds = time[2 * SPAN :] - time[: -2 * SPAN]
    turn = (attitude[: -2 * SPAN].inv() * attitude[2 * SPAN :]).as_rotvec()
    error = turn - quantities["gyro"][SPAN:-SPAN] * seconds[:, None]
    return float((error**2).mean())
