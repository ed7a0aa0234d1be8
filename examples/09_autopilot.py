"""Connect another autopilot: a short controller takes the drone through the gates of one lap."""

import socket
import subprocess
import sys
import time

import numpy as np

from quadjax import sil_message as sil

HOST, PORT = "127.0.0.1", 40_000 + time.time_ns() % 20_000


def control(state):  # returns body rates, rad/s, and specific thrust, m/s^2
    yaw = state["gate_yaw_rad"]
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])  # the line through the next gate
    place = state["position_ned_m"] - state["gate_position_ned_m"]
    aside = place - ahead * (place @ ahead)  # off this line
    late = place @ ahead > -0.7 and aside @ aside > 0.1  # too close to reach the opening
    wanted = ahead * (-1.0 if late else 3.5 / (1.0 + aside @ aside)) - 2.5 * aside
    force = np.clip(3.0 * (wanted - state["velocity_ned_m_s"]), -7.0, 7.0) - [0.0, 0.0, 9.81]
    w, *vector = state["quaternion_wxyz"]
    down = -force / (thrust := np.linalg.norm(force))
    down = down + 2.0 * np.cross(vector, np.cross(vector, down) - w * down)  # world to body
    return [-8.0 * down[1], 8.0 * down[0], np.sin(yaw - state["attitude_rpy_rad"][2]), thrust]


def main():
    command = f"-m quadjax sil indi --laps 1 --listen {HOST}:{PORT}"
    drone = subprocess.Popen([sys.executable, *command.split()])
    autopilot = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    autopilot.connect((HOST, PORT))
    message = sil.new(sil.Kind.HELLO)
    while drone.poll() is None:
        try:
            message["command_kind"] = sil.CommandKind.RATES_RAD_S_AND_THRUST_M_S2
            autopilot.send(sil.pack(message))
            state = sil.unpack(autopilot.recv(4096))
            if state["kind"] == sil.Kind.END:
                break
            message = sil.new(sil.Kind.COMMAND, state["run"], state["sequence"], state["time_s"])
            message["command"] = control(state)
        except ConnectionRefusedError:  # the drone is not ready
            time.sleep(0.5)
    return drone.wait()


if __name__ == "__main__":
    sys.exit(main())
