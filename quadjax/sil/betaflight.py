"""Betaflight flies a drone with motor commands; the exported C moves its sticks.

The policy commands body rates and thrust. The firmware's rate profile makes a stick a body rate,
and the drone's own motor map makes a thrust a throttle.
"""

import contextlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from quadjax.config.assembly import make_race
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors
from quadjax.export.conversion import Converted
from quadjax.export.library import VEHICLE
from quadjax.flights.flight import AXES, RATES, Signal
from quadjax.sil.autopilot import Autopilot, ExportedC
from quadjax.sil.betaflight_firmware import (
    CENTER,
    HIGH,
    LOW,
    STEP,
    Firmware,
    find_firmware,
    state_of,
)
from quadjax.sil.drones import SimulatedDrone, simulator_drone
from quadjax.vehicle.racing import MODEL, RacingConstants, motor_map
from quadjax.vehicle.vehicle_file import for_each_rotor

THROTTLE_LOW = 1050  # the stick of throttle 0, which is Betaflight's min_check
COARSEST = 10.0  # step of the rate profile, deg/s
# All else has Betaflight's defaults, such as the gains.
SETTINGS = (
    "set acc_calibration = 0,0,0,1",
    "set small_angle = 180",
    "set pwr_on_arm_grace = 0",
    "set runaway_takeoff_prevention = OFF",
    "set motor_idle = 0",  # the drone's motors turn at command 0
    "set rc_smoothing = OFF",
    "set throttle_boost = 0",
    "set airmode_start_throttle_percent = 0",
    "feature AIRMODE",
    "aux 0 0 0 1700 2100 0 0",  # arms with AUX1
    "set rates_type = ACTUAL",
)
RESTING = np.zeros((), VEHICLE)
RESTING["quaternion"], RESTING["specific_force"] = (1, 0, 0, 0), (0, 0, -9.81)
ARMING, ATTEMPTS, TESTED = 200, 20, 40  # exchanges, attempts, and exchanges of a test


class Sticks:
    """From body rates and thrust to sticks."""

    def __init__(self, constants: RacingConstants, highest: np.ndarray) -> None:
        """Take the drone, and the highest body rates (3,), rad/s."""
        self.profile = np.ceil(np.degrees(highest) / COARSEST) * COARSEST  # (3,) deg/s
        self._commands = np.linspace(0.0, 1.0, 1001)
        speed = np.array(motor_map(constants, Rotors.same(jnp.asarray(self._commands))).w1)
        self._thrusts = 4.0 * float(constants.k_w) * speed**2

    def settings(self, turning: float) -> list[str]:
        """The settings of the firmware; ``turning`` is that of the front-left rotor."""
        lines = [*SETTINGS, f"set yaw_motors_reversed = {'ON' if turning > 0 else 'OFF'}"]
        for axis, rate in zip(("roll", "pitch", "yaw"), self.profile, strict=True):
            number = round(rate / COARSEST)
            lines += [f"set {axis}_rc_rate = {number}", f"set {axis}_srate = {number}"]
            lines += [f"set {axis}_expo = 0", f"set {axis}_rate_limit = 1998"]
        return lines

    def of(self, command: np.ndarray) -> list[int]:
        """Roll, pitch, throttle, yaw and AUX1 of p, q, r (rad/s) and thrust (m/s^2), armed."""
        p, q, r = (HIGH - CENTER) * np.degrees(command[:3]) / self.profile
        share = np.interp(command[3], self._thrusts, self._commands)
        numbers = CENTER + p, CENTER - q, THROTTLE_LOW + (HIGH - THROTTLE_LOW) * share, CENTER + r
        return [*(round(float(np.clip(x, LOW, HIGH))) for x in numbers), HIGH]


class Betaflight:
    """Betaflight under the commands of a policy: an ``Autopilot``; its commands are motors'."""

    def __init__(self, firmware: Firmware, pilot: Autopilot, sticks: Sticks, every: int) -> None:
        """Take the running firmware and the pilot, which is called once in ``every`` steps."""
        self._firmware, self._pilot, self._sticks, self._every = firmware, pilot, sticks, every
        self.label = f"Betaflight, {pilot.label}"

    @property
    def files(self) -> str:
        """What flies."""
        return f"{self._firmware.version}, {self._pilot.files}"

    def begin(self) -> None:
        """A race begins with the next call: arm, which resets the firmware's control loops.

        Raises:
            InputError: the firmware does not arm.
        """
        arm(self._firmware)
        self._pilot.begin()
        self._calls, self._status, self._command = 0, 0, np.zeros(4, np.float32)
        self._rows = list[np.ndarray]()

    def step(self, now_us: int, vehicle: np.ndarray | None) -> tuple[int, np.ndarray]:
        """See ``Autopilot``."""
        if self._calls % self._every == 0:
            if vehicle is not None:
                vehicle = vehicle.copy()
                vehicle["autopilot_command"] = self._command
            self._status, self._command = self._pilot.step(now_us, vehicle)
        self._calls += 1
        force = (RESTING if vehicle is None else vehicle)["specific_force"]
        self._rows.append(np.concatenate([force, self._command]))
        return self._status, exchange(self._firmware, vehicle, self._sticks.of(self._command))

    def counts(self) -> dict[str, int]:
        """What was wrong with the states in this race, by the pilot."""
        return self._pilot.counts()

    def outside(self) -> list[str]:
        """The inputs of the policy that were outside their range in this race."""
        return self._pilot.outside()

    def signals(self) -> dict[str, Signal]:
        """The specific force, and the commands of the policy, as of a flight log."""
        rows = np.reshape(self._rows, (-1, 7))
        return {
            "specific_force": Signal(rows[:, :3], "m/s^2", AXES),
            "rate_command": Signal(rows[:, 3:6], "rad/s", RATES),
            "thrust_command": Signal(rows[:, 6:], "m/s^2", ("thrust",)),
        }


def lines(settings: Sequence[str]) -> list[str]:
    """Settings, ``NAME=VALUE``, as lines of the firmware's command line."""
    return [f"set {setting.replace('=', ' = ', 1)}" for setting in settings]


def exchange(firmware: Firmware, vehicle: np.ndarray | None, sticks: list[int]) -> np.ndarray:
    """The motor commands (4,) of a state and sticks; without a state, the drone is at rest."""
    now = RESTING if vehicle is None else vehicle
    return firmware.exchange(
        state_of(now["rates"], now["specific_force"], now["quaternion"]), sticks
    )


def arm(firmware: Firmware) -> None:
    """Disarm and arm at rest, until the motors follow the throttle.

    Raises:
        InputError: they do not.
    """
    off, low = [CENTER, CENTER, LOW, CENTER, LOW], [CENTER, CENTER, LOW, CENTER, HIGH]
    throttle = [CENTER, CENTER, CENTER, CENTER, HIGH]
    for _ in range(ATTEMPTS):
        for sticks, count in ((off, ARMING), (low, ARMING), (throttle, TESTED)):
            for _ in range(count):
                motors = exchange(firmware, None, sticks)
        if motors.min() > 0.0:
            return
    raise InputError(f"Betaflight does not arm: {firmware.arming_flags()}")


def check_turns(firmware: Firmware, constants: RacingConstants) -> None:
    """Check that the motors act against a turn about each axis.

    Raises:
        InputError: they do not, so signs, rotors or their directions differ.
    """
    moments = MODEL.allocation(constants)
    throttle = [CENTER, CENTER, CENTER, CENTER, HIGH]
    for axis, name in enumerate(("roll", "pitch", "yaw")):
        arm(firmware)
        before, turning = exchange(firmware, None, throttle), RESTING.copy()
        turning["rates"][axis] = 0.5
        for _ in range(TESTED):
            after = exchange(firmware, turning, throttle)
        if moments[1 + axis] @ (after - before) >= 0.0:
            raise InputError(f"Betaflight's motors do not act against a {name} of the drone")


def drone_of(config: Config, laps: int) -> SimulatedDrone:
    """The drone with motor commands of a race, in its simulator.

    Raises:
        InputError: the vehicle has no constants of the model ``racing``.
    """
    vehicle = config.vehicle.with_model(MODEL.name)
    constants = for_each_rotor(vehicle.constants, MODEL.constant_names)
    vehicle = vehicle.replace(constants=constants)
    rules = config.rules.replace(time_step=STEP)
    return simulator_drone(*make_race(config.replace(vehicle=vehicle, rules=rules)), laps)


@contextlib.contextmanager
def betaflight_in_race(
    converted: Converted, work: Path, laps: int, settings: Sequence[str] = ()
) -> Iterator[tuple[SimulatedDrone, Betaflight]]:
    """The drone of a policy's race, and the running firmware with the policy at its sticks.

    Args:
        converted: the policy.
        work: folder for the C.
        laps: of a race.
        settings: of the firmware, ``NAME=VALUE``, beyond ``SETTINGS``.

    Raises:
        InputError: a rejected setting, a policy or vehicle of another model, or a firmware that
            does not start.
    """
    policy, config = converted.policy, converted.race.config
    if policy.vehicle != "rate":
        raise InputError(
            f"{converted.file}: a policy for vehicle.model={policy.vehicle}, --autopilot "
            "betaflight flies those of: rate"
        )
    drone = drone_of(config, laps)
    every = round(config.rules.time_step / STEP)
    if not math.isclose(every * STEP, config.rules.time_step, rel_tol=1e-6):
        raise InputError(f"rules.time_step is {config.rules.time_step:g}, allowed: whole ms")
    constants = drone.params.vehicle.constants
    highest = np.maximum(np.abs(policy.command_low), np.abs(policy.command_high))[:3]
    sticks = Sticks(constants, highest)
    pilot = ExportedC(converted, work, 1.0 / config.rules.time_step)
    own = sticks.settings(float(constants.turning.w1))
    with Firmware(find_firmware(), [*own, *lines(settings)]) as firmware:
        check_turns(firmware, constants)
        yield drone, Betaflight(firmware, pilot, sticks, every)
