"""Read flight logs of another format: .npz files with rotor speeds in rad/s, angles in degrees."""

import numpy as np

import quadjax


def read(path):
    """The columns (n,) of a file by name."""
    with np.load(path) as arrays:
        return dict(arrays)


FORMAT = quadjax.LogFormat(
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


def main():
    """Write the log of a level drone that swings north and south, with noise, and read it."""
    time, random = np.arange(0.0, 5.0, 0.004), np.random.default_rng(0)
    names = [name for group in FORMAT.columns.values() for name in group]
    flight = {name: 0.001 * random.normal(size=len(time)) for name in names}
    flight |= {name: 785.0 + flight[name] for name in FORMAT.columns["rpm"]}
    swing = {"time": time, "vx": np.sin(3.0 * time), "ax": 3.0 * np.cos(3.0 * time)}
    np.savez("flight.npz", **flight | swing | {"az": flight["az"] - 9.81})
    log = quadjax.read_log("flight.npz", quadjax.LogsConfig(format="08_log_format:FORMAT"))
    mean, unchecked = log["actuators"].mean(), log.source["unchecked"]
    print(f"{log.sample_rate:.0f} Hz, {mean:.0f} rpm; not checked: {unchecked}")


if __name__ == "__main__":
    main()
