"""Connect exported C to another autopilot, and move its estimate through the first gate."""

import ctypes
import subprocess
from pathlib import Path

import numpy as np

import quadjax

GLUE = Path(__file__).with_name("09_autopilot.c")
VECTORS = {"position": 3, "velocity": 3, "rates": 3, "quaternion": 4, "thrust": 1}  # float32
TIMES = [("time_us", "<u4"), ("position_us", "<u4")]
ESTIMATE = [*TIMES, *((name, "<f4", size) for name, size in VECTORS.items())]


def main():
    policy = quadjax.Policy.load("indi")
    options = {"name": "racer", "target": "cortex-m7", "overwrite": True}
    folder = quadjax.export_c(policy, "indi_in_c", **options).folder / "c"
    files = [GLUE, *sorted(folder.glob("qj_*.c"))]
    flags = ["-O2", "-shared", "-fPIC", f"-I{folder}", "-lm", "-o", "autopilot.so"]
    subprocess.run(["cc", *files, *flags], check=True)
    autopilot = ctypes.CDLL(str(Path("autopilot.so").resolve()))
    autopilot.policy_setup.restype = ctypes.c_char_p
    if wrong := autopilot.policy_setup():
        raise SystemExit(f"the policy cannot fly: {wrong.decode()}")
    gate = quadjax.load("indi").track.gates[0]
    yaw = np.deg2rad(gate.yaw_deg)
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    estimate, command = np.zeros((), ESTIMATE), np.zeros(4, np.float32)
    estimate["quaternion"] = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
    estimate["velocity"], estimate["thrust"] = ahead, 9.81
    places = [ctypes.c_void_p(array.ctypes.data) for array in (estimate, command)]
    for loop in range(1000):  # of 500 Hz: from 1 m before the gate to 1 m behind it
        estimate["time_us"] = estimate["position_us"] = 2000 * loop
        estimate["position"] = np.array(gate.position) + (loop / 500.0 - 1.0) * ahead
        autopilot.policy_loop(2000 * loop, places[0], 1, places[1])
        if loop % 250 == 0:
            rates = ", ".join(f"{rate:.2f}" for rate in command[:3])
            print(f"target gate {autopilot.policy_target_gate()}: rates {rates} rad/s, "
                  f"thrust {command[3]:.1f} m/s^2")  # fmt: skip


if __name__ == "__main__":
    main()
