"""Fly your own autopilot: a short controller takes the drone through the gates of one lap."""

import os
import socket
import subprocess
import sys
import time

import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.sil.message import CommandKind, Kind, new, pack, unpack

ADDRESS = ("127.0.0.1", 40_000 + os.getpid() % 20_000)


def control(state):
    """Body rates, rad/s, and specific thrust, m/s^2: along the line through the next gate."""
    yaw, velocity = state["gate_yaw_rad"], state["velocity_ned_m_s"]
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    place = state["position_ned_m"] - state["gate_position_ned_m"]
    aside = place - ahead * (place @ ahead)  # off that line
    late = place @ ahead > -0.7 and aside @ aside > 0.1  # too close to reach the opening
    wanted = ahead * (-1.0 if late else 3.5 / (1.0 + aside @ aside)) - 2.5 * aside
    force = np.clip(3.0 * (wanted - velocity), -7.0, 7.0) - [0.0, 0.0, 9.81]
    body = Rotation.from_quat(np.roll(state["quaternion_wxyz"], -1)).inv()
    down = body.apply(-force / np.linalg.norm(force))  # where the body's z axis should point
    turn = np.sin(yaw - state["attitude_rpy_rad"][2])
    return [-8.0 * down[1], 8.0 * down[0], turn, np.linalg.norm(force)]


race = [sys.executable, "-m", "quadjax", "sil", "indi", "--laps", "1", "--listen"]
drone = subprocess.Popen([*race, f"{ADDRESS[0]}:{ADDRESS[1]}"])
own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
own.connect(ADDRESS)
message = new(Kind.HELLO)
while drone.poll() is None:
    try:
        message["command_kind"] = CommandKind.RATES_RAD_S_AND_THRUST_M_S2
        own.send(pack(message))
        state = unpack(own.recv(4096))
        if state["kind"] == Kind.END:
            break
        message = new(Kind.COMMAND, state["run"], state["sequence"], state["time_s"])
        message["command"] = control(state)
    except ConnectionRefusedError:  # the drone is not ready
        time.sleep(0.5)
sys.exit(drone.wait())
