"""Read your own flight logs: an .npz file with rotor speeds in rad/s and angles in degrees."""

import numpy as np

from quadjax import VehicleParams
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.flight_log import read_log
from quadjax.fitting.formats import LogFormat
from quadjax.fitting.simulate import simulate_flight
from quadjax.vehicle.vehicle_file import read_vehicle


def read(path):
    """The columns (n,) of a file by name."""
    with np.load(path) as arrays:
        return dict(arrays)


FORMAT = LogFormat(
    columns={
        "time": ["time"],
        "rpm": ["front_left", "front_right", "rear_right", "rear_left"],
        "gyro": ["rate_p", "rate_q", "rate_r"],
        "acceleration": ["ekf_U1", "ekf_U2", "ekf_U3"],
        "world_velocity": ["vel_x", "vel_y", "vel_z"],
        "euler": ["roll", "pitch", "yaw"],
    },
    units={"rpm": "rad/s", "angle": "deg"},
    read=read,
)

if __name__ == "__main__":
    flown = simulate_flight(VehicleParams(read_vehicle("bebop1.yaml").motor), 1, seconds=5.0)
    for i, name in enumerate(FORMAT.columns["rpm"]):
        flown[name] = flown.pop(f"rpm_obs_{i + 1}") * np.pi / 30.0
    for name, angle in zip(("roll", "pitch", "yaw"), ("phi", "theta", "psi"), strict=True):
        flown[name] = np.degrees(flown.pop(f"att_{angle}"))
    np.savez("flight.npz", **flown)
    log = read_log("flight.npz", LogsConfig(format="own_log_format:FORMAT"))
    print(f"{log.sample_rate:.0f} Hz, {log.rpm.mean():.0f} rpm; not checked: {log.unchecked}")
