"""Flights of racing quadcopters by the float64 reference, in the columns of other autopilots."""

import csv
import struct

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from tests.vehicle.rigid_reference import PUBLISHED, Q, V, racing_derivative, rotation

G, RATE = 9.81, 500.0
ORDER = ("front_left", "front_right", "rear_right", "rear_left")
ROLL, PITCH = np.array([1.0, -1.0, -1.0, 1.0]), np.array([1.0, 1.0, -1.0, -1.0])
PX4 = [1, 3, 0, 2]  # front-right, rear-left, front-left, rear-right


def constants(path):
    """The file's numbers by name, per-rotor ones (4,) in the order of ``ORDER``."""
    tree = yaml.safe_load(path.read_text())
    place = [tree["rotors"].index(name) for name in ORDER]
    found = {}
    for name, value in tree["racing"].items():
        if isinstance(value, list):
            value = [{"cw": -1.0, "ccw": 1.0}.get(item, item) for item in value]
            found[name] = np.array([float(value[i]) for i in place])
        else:
            per_rotor = name in ("k_p", "k_q", "k_r", "k_rd")
            found[name] = np.full(4, float(value)) if per_rotor else float(value)
    return found


def _command(c, x, target, hover, mixer):
    matrix = rotation(x[None, Q])[0]
    roll, pitch = np.arctan2(matrix[2, 1], matrix[2, 2]), -np.arcsin(np.clip(matrix[2, 0], -1, 1))
    yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
    turn = (target[2] - yaw + np.pi) % (2 * np.pi) - np.pi
    wanted = np.array([60 * (target[0] - roll), 60 * (target[1] - pitch), 6 * turn])
    wanted -= np.array([12, 12, 4]) * x[10:13]
    climb = G + 3.0 * (x[5] - target[3])
    lift = max(climb, 1.0) / max(matrix[2, 2], 0.4) - G
    w = hover + mixer @ np.array([lift, *wanted])
    s = np.clip((w - c["w_min"]) / (c["w_max"] - c["w_min"]), 0.0, 1.0) ** 2
    b = 1 - c["k"]
    u = (-b + np.sqrt(b * b + 4 * c["k"] * s)) / (2 * c["k"])
    return np.clip(u + target[4:], 0.02, 1.0)


def fly(c, seed, seconds):
    """A flight: signals by name, (n, ..), at ``RATE``; noise on gyro and accelerometer."""
    published = c | {name: c[name][PUBLISHED] for name in ("k_p", "k_q", "k_r", "k_rd")}
    random, count = np.random.default_rng(seed), int(seconds * RATE)
    time = np.arange(count)[:, None] / RATE
    targets = np.zeros((count, 8))
    scale = np.array([0.5, 0.5, 1.2, 3.0, *[0.03] * 4])
    for low, high, weight in ((0.15, 0.4, 0.7), (0.4, 1.0, 0.5), (1.0, 2.5, 0.3)):
        f = random.uniform(low, high, 8) * np.array([1, 1, 1, 1, 4, 4, 4, 4])
        targets += weight * scale * np.sin(2 * np.pi * (f * time + random.uniform(0, 1, 8)))
    hover = np.full(4, np.sqrt(G / (4 * c["k_w"])))
    rows = [np.full(4, c["k_w"]), ROLL * c["k_p"], PITCH * c["k_q"]]
    yaw = c["turning"] * (c["k_r"] + 5.0 * c["k_rd"])
    mixer = np.linalg.inv(np.array([*(2 * hover * row for row in rows), yaw]))
    x = np.concatenate([np.zeros(6), [1, 0, 0, 0], np.zeros(3), hover])
    states, commands, dt = [], [], 1 / RATE
    for target in targets:
        u = _command(c, x, target, hover, mixer)
        states.append(x)
        commands.append(u)
        middle = x + 0.5 * dt * racing_derivative(published, x[None], u[None])[0]
        x = x + dt * racing_derivative(published, middle[None], u[None])[0]
        x[Q] /= np.sqrt(x[Q] @ x[Q])
    s, commands = np.array(states), np.array(commands)
    attitude = Rotation.from_quat(s[:, [7, 8, 9, 6]])
    acceleration = racing_derivative(published, s, commands)[:, V]
    force = attitude.inv().apply(acceleration - [0.0, 0.0, G])
    noise = random.normal(size=(2, count, 3))
    return {
        "time": time[:, 0],
        "position": s[:, :3],
        "velocity": s[:, 3:6],
        "attitude": attitude,
        "quaternion": s[:, 6:10],
        "gyro": s[:, 10:13] + 0.01 * noise[0],
        "force": force + 0.2 * noise[1],
        "speed": s[:, 13:],
        "command": commands,
    }


def blackbox_columns(flight, flu=False):
    """Columns of integers, as in a blackbox log."""
    flip = np.array([1, -1, -1]) if flu else 1
    signals = {
        "time": (flight["time"] * 1e6 + 7e6)[:, None],
        "gyroADC": np.degrees(flight["gyro"]) * flip,
        "accSmooth": flight["force"] * flip / 9.80665 * 2048,
        "motor": 158 + (2048 - 158) * flight["command"][:, PUBLISHED],
        "omega": flight["speed"][:, PUBLISHED],
        "pos": flight["position"] * 1000,
        "vel": flight["velocity"] * 100,
        "quat": flight["quaternion"] * ((127 << 6) - 1),
    }
    columns = {}
    for name, values in signals.items():
        for i, column in enumerate(np.rint(values).astype(int).T):
            columns[name if name == "time" else f"{name}[{i}]"] = column
    return columns


def write_blackbox(path, columns, settings=()):
    head = {"Product": "Blackbox flight data recorder", "acc_1G": 2048, "motorOutput": "158,2048"}
    with open(path, "w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerows((head | dict(settings)).items())
        writer.writerow(["loopIteration", *columns, "flightModeFlags (flags)"])
        for i, row in enumerate(zip(*columns.values(), strict=True)):
            writer.writerow([i, *row, "ARM|ANGLE"])


def tii_columns(flight, by_rows=True):
    """Columns of the dataset: z-up world, FLU body."""
    flip = np.array([1, -1, -1])
    to_enu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    matrix = to_enu @ flight["attitude"].as_matrix() @ np.diag(flip)
    signals = {
        "accel_": flight["force"] * flip,
        "gyro_": flight["gyro"] * flip,
        "drone_": flight["position"] @ to_enu.T,
        "drone_velocity_linear_": flight["velocity"] @ to_enu.T,
    }
    columns = {"elapsed_time": flight["time"]}
    for name, values in signals.items():
        columns |= {f"{name}{axis}": values[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"thrust[{i}]": flight["command"][:, k] for i, k in enumerate(PUBLISHED)}
    order = matrix if by_rows else matrix.transpose(0, 2, 1)
    return columns | {f"drone_rot[{i}]": order.reshape(-1, 9)[:, i] for i in range(9)}


def write_tii(path, columns):
    with open(path, "w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow([*columns, "img_filename"])
        for row in zip(*columns.values(), strict=True):
            writer.writerow([*(f"{value:.7g}" for value in row), "00001.jpg"])


def ulog_topics(flight):
    """Topics by name: rate, Hz, and fields (n, ..) of single precision.

    Rates of PX4's profiles "default" and "high rate" together: the position every 100 ms, the
    telemetry of the speed controllers every 5 ms at most, the rest as it is published.
    """
    place = dict(zip("xyz", flight["position"].T, strict=True))
    velocity = dict(zip(("vx", "vy", "vz"), flight["velocity"].T, strict=True))
    rpm = flight["speed"][:, PX4].T * 30 / np.pi
    unused = np.full((len(flight["time"]), 8), np.nan)
    return {
        "vehicle_angular_velocity": (500, {"xyz": flight["gyro"]}),
        "sensor_combined": (250, {"accelerometer_m_s2": flight["force"]}),
        "vehicle_attitude": (250, {"q": flight["quaternion"]}),
        "vehicle_local_position": (10, place | velocity),
        "esc_status": (RATE / 3, {f"esc[{i}].esc_rpm": values for i, values in enumerate(rpm)}),
        "actuator_motors": (500, {"control": np.hstack([flight["command"][:, PX4], unused])}),
    }


def write_ulog(path, flight, topics, lost=None, instances=None):
    """A ULog file: header, flag bits, formats, subscriptions and data in the order of time.

    Args:
        path: of the file.
        flight: that is written.
        topics: as of ``ulog_topics``.
        lost: by topic, the times between which it has no samples.
        instances: by topic, if not the first alone; the same data for all.
    """
    lost, instances = lost or {}, instances or {}
    every = [(name, i) for name in topics for i in instances.get(name, [0])]

    def message(kind, body):
        return struct.pack("<HB", len(body), ord(kind)) + body

    data, head, subscriptions = [], [], []
    for number, (topic, instance) in enumerate(every):
        (rate, fields), silent = topics[topic], lost.get(topic, (np.inf, np.inf))
        names, columns = [], []
        for name, values in fields.items():
            values = np.asarray(values)
            kind = "int32_t" if name.endswith("rpm") else "float"
            size = f"[{values.shape[1]}]" if values.ndim > 1 else ""
            names.append(f"{kind}{size} {name}")
            columns += [(kind, column) for column in np.atleast_2d(values.T)]
        if topic == "esc_status":  # a nested message, as in PX4
            head.append(message("F", b"esc_report:int32_t esc_rpm;"))
            names = [f"esc_report[{len(fields)}] esc"]
        text = f"{topic}:uint64_t timestamp;{';'.join(names)};"
        if instance == instances.get(topic, [0])[0]:
            head.append(message("F", text.encode()))
        subscriptions.append(message("A", struct.pack("<BH", instance, number) + topic.encode()))
        step = round(RATE / rate)
        codes = "<HQ" + "".join("i" if kind == "int32_t" else "f" for kind, _ in columns)
        for row in range(0, len(flight["time"]), step):
            if silent[0] < flight["time"][row] < silent[1]:
                continue
            time = int(flight["time"][row] * 1e6) + 10_000_000
            numbers = [int(round(c[row])) if k == "int32_t" else c[row] for k, c in columns]
            data.append((time, number, message("D", struct.pack(codes, number, time, *numbers))))
    with open(path, "wb") as stream:
        stream.write(b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + struct.pack("<Q", 10_000_000))
        stream.write(message("B", bytes(40)))
        for part in (*head, *subscriptions, *(body for _, _, body in sorted(data))):
            stream.write(part)
