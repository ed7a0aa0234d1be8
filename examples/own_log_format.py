"""Read your own flight logs: an .npz file with rotor speeds in rad/s and angles in degrees."""

import numpy as np

from quadjax.fitting.config import LogsConfig
from quadjax.fitting.flight_log import read_log
from quadjax.fitting.formats import LogFormat


def read(path):
    """The columns (n,) of a file by name."""
    with np.load(path) as arrays:
        return dict(arrays)


FORMAT = LogFormat(
    columns={
        "time": ["time"],
        "rpm": ["front_left", "front_right", "rear_right", "rear_left"],
        "gyro": ["p", "q", "r"],
        "acceleration": ["ax", "ay", "az"],
        "world_velocity": ["vx", "vy", "vz"],
        "euler": ["roll", "pitch", "yaw"],
    },
    units={"rpm": "rad/s", "angle": "deg"},
    read=read,
)

if __name__ == "__main__":  # a level drone that swings north and south, with noise
    time, random = np.arange(0.0, 5.0, 0.004), np.random.default_rng(0)
    names = [name for group in FORMAT.columns.values() for name in group]
    flight = {name: 0.001 * random.normal(size=len(time)) for name in names}
    flight |= {name: 785.0 + flight[name] for name in FORMAT.columns["rpm"]}
    swing = {"time": time, "vx": np.sin(3.0 * time), "ax": 3.0 * np.cos(3.0 * time)}
    np.savez("flight.npz", **flight | swing | {"az": flight["az"] - 9.81})
    log = read_log("flight.npz", LogsConfig(format="own_log_format:FORMAT"))
    mean, unchecked = log["actuators"].mean(), log.source["unchecked"]
    print(f"{log.sample_rate:.0f} Hz, {mean:.0f} rpm; not checked: {unchecked}")
