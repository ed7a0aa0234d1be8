"""The glue of an autopilot in a stand-in for its firmware, on this machine."""

import ctypes
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from quadjax.core import quaternion
from quadjax.core.vectors import Vec3
from quadjax.export.pilot_emulator import PilotEmulator
from quadjax.export.targets import calls_per_step
from quadjax.export.verify.build import VEHICLE, Sources, pointers
from quadjax.export.verify.result import require
from quadjax.export.verify.toolchain import host
from quadjax.export.words import COMMANDS, FixedPolicy
from quadjax.race.layout import LAST_ACTION

GLUE_STEPS, GLUE_TOLERANCE = 50, 2e-5  # of a command's range: an autopilot has other units


def build_autopilot(
    sources: Sources, output: Path, others: Sequence[Path] = (), options: Sequence[str] = ()
) -> Path:
    """Build the glue of a target and other C, in a stand-in for its firmware, for this machine.

    ``output`` is a library whose functions are those of ``firmware.h`` and of the other C.
    Multiplications are not fused, so that every machine computes the same.
    """
    files, of_glue = sources.autopilot()
    options = ["-shared", "-fPIC", *of_glue, "-ffp-contract=off", *options, "-lm"]
    return host().build([*files, *others], output, options)


class Autopilot:
    """The glue of a target with its policy, in a stand-in for its firmware, on this machine.

    Attributes:
        wrong: why the policy does not fly; None if it does.
        armed: whether the autopilot allowed arming at the last call.
    """

    def __init__(self, sources: Sources, work: Path, options: Sequence[str] = ()) -> None:
        """Build it and start the firmware."""
        self._library = ctypes.CDLL(str(build_autopilot(sources, work / "glue.so", (), options)))
        self._library.firmware_start.restype = ctypes.c_char_p
        reason = self._library.firmware_start()
        self.wrong = reason and reason.decode()
        self.armed = False

    def call(self, vehicle: np.ndarray, flies: bool = True) -> np.ndarray:
        """Call the glue at the time of a ``VEHICLE`` (1,); returns the command (4,) float32.

        ``flies``: whether the mode of the policy is on.
        """
        command = np.zeros(COMMANDS, np.float32)
        place, out = pointers(vehicle, command)
        now = int(vehicle["time_us"][0])
        self.armed = bool(self._library.firmware_call(now, place, int(flies), out))
        return command

    def value(self, name: str, kind: Any) -> Any:
        """A variable of the stand-in, as a type of ctypes."""
        return kind.in_dll(self._library, name)


def compare_glue(sources: Sources, policy: FixedPolicy, work: Path) -> str:
    """Compare the commands of a target's glue with those of NumPy, along a race.

    Returns:
        The largest difference, as text.

    Raises:
        Failed: the glue rejects the policy, or commands something else.
    """
    target, glue = sources.target, Autopilot(sources, work)
    require(glue.wrong is None, f"the glue rejects the policy: {glue.wrong}")
    held = LAST_ACTION in policy.race.box.layout
    calls = calls_per_step(1e9 / sources.call_ns, policy.race.time_step) if held else 1
    emulated, rows = PilotEmulator(policy, calls), random_vehicles(GLUE_STEPS)
    network = policy.network
    span = (network.command_high - network.command_low) * 0.5**network.fraction_bits
    worst, now = 0.0, 0.0
    for number, row in enumerate(np.repeat(rows, calls)[:, None]):
        now += 1e-3 * sources.call_ns
        row["time_us"] = round(now)
        apart = np.abs(glue.call(row).astype(np.float64) - emulated.call(row[0]))
        worst = max(worst, float(np.max(apart / span)))
        require(worst <= GLUE_TOLERANCE, f"call {number}: {worst:.2g} of a command's range apart")
    require(glue.armed, "the autopilot does not allow arming")
    return (
        f"{GLUE_STEPS} steps through the glue of {target.autopilot}, in a stand-in for its "
        f"firmware: within {worst:.1g} of a command's range of NumPy"
    )


def random_vehicles(count: int) -> np.ndarray:
    """States (count,) of ``VEHICLE`` in flight, in numbers that every autopilot represents."""
    rng, vehicles = np.random.default_rng(1), np.zeros(count, VEHICLE)
    for name in ("position", "velocity", "rates", "body_velocity"):
        vehicles[name] = rng.uniform(-1.0, 1.0, (count, 3))
    vehicles["gyro"] = vehicles["rates"]
    vehicles["euler"] = rng.uniform(-1.0, 1.0, (count, 3))
    turned = quaternion.of_euler(Vec3(*vehicles["euler"].astype(np.float64).T))
    vehicles["quaternion"] = np.stack([np.asarray(x) for x in jax.tree.leaves(turned)], axis=1)
    vehicles["rpm"] = np.rint(rng.uniform(3000.0, 10_000.0, (count, 4)))
    vehicles["rotor_speed"] = vehicles["rpm"] * np.float32(np.pi / 30.0)
    vehicles["specific_force"] = np.rint(rng.uniform(-9.0, 9.0, (count, 3)) * 1024.0) / 1024.0
    vehicles["thrust"] = -vehicles["specific_force"][:, 2:]
    vehicles["others_command"] = vehicles["rpm"]
    return vehicles
