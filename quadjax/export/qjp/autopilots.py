"""Files of autopilots around a ``.qjp`` policy: a module of PX4, a controller of the Crazyflie."""

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.fixed import FixedNetwork
from quadjax.export.qjp.emit import LOADER, qjp_source
from quadjax.export.race_tables import RaceTables
from quadjax.export.render import render
from quadjax.export.targets import check_model
from quadjax.race.layout import DISTURBANCES

PX4_FOLDER, CRAZYFLIE_FOLDER = "px4", "crazyflie"
PX4_MODULE = f"{PX4_FOLDER}/src/modules/quadjax_policy"  # in EXTERNAL_MODULES_LOCATION
PX4_FILES = ("CMakeLists.txt", "Kconfig", "QuadjaxPolicy.hpp", "QuadjaxPolicy.cpp")
PILOT = ("qjp_pilot.h", "qjp_pilot.c")
TICK = 1e-3  # s, of the Crazyflie's stabilizer
ROTOR_SPEED = "rotor_speed"


def check_motor_policy(target: str, network: FixedNetwork, race: RaceTables) -> None:
    """Check that a policy commands motors from 0 to 1 and observes no disturbances.

    Raises:
        InputError: other commands, or a field that the autopilot cannot give.
    """
    unit = 2.0**network.fraction_bits
    low, high = network.command_low / unit, network.command_high / unit
    check_model(target, network.model.name)
    if np.any(low < 0.0) or np.any(high > 1.0):
        raise InputError(
            f"--target {target}: motor commands {low.tolist()}..{high.tolist()}, allowed: 0 to 1"
        )
    unknown = [name for name in race.box.layout.names if name in DISTURBANCES]
    if unknown:
        raise InputError(f"--target {target}: the policy observes {unknown[0]}, which it lacks")


def check_crazyflie(network: FixedNetwork, race: RaceTables, time_step: float) -> None:
    """Check that a Crazyflie can fly a policy.

    Raises:
        InputError: see ``check_motor_policy``; a policy that observes rotor speeds, or a time step
            that is no whole number of ms.
    """
    check_motor_policy("crazyflie", network, race)
    if ROTOR_SPEED in race.box.layout:
        raise InputError(
            "--target crazyflie: the policy observes rotor_speed, which a Crazyflie does not "
            "measure; train with observation.actuators=false observation.last_action=true"
        )
    if abs(time_step / TICK - round(time_step / TICK)) > 1e-6:
        raise InputError(
            f"--target crazyflie: the time step is {time_step:g} s, allowed: whole milliseconds"
        )


def emit_px4(network: FixedNetwork, race: RaceTables) -> dict[str, str]:
    """PX4's module, by path; it is the same for every policy."""
    check_motor_policy("px4", network, race)
    files = {f"{PX4_MODULE}/{file}": render(f"px4/{file}", {}) for file in PX4_FILES}
    return files | {f"{PX4_MODULE}/{file}": qjp_source(file) for file in (*LOADER, *PILOT)}


def emit_crazyflie(
    name: str, data: bytes, network: FixedNetwork, race: RaceTables, time_step: float
) -> dict[str, str]:
    """The Crazyflie's out-of-tree app, by path, with the policy's file as a table."""
    check_crazyflie(network, race, time_step)
    folder = CRAZYFLIE_FOLDER
    words = np.frombuffer(data, "<i4")
    files = {f"{folder}/{file}": render(f"crazyflie/{file}", {}) for file in ("Kbuild", "Makefile")}
    files[f"{folder}/app-config"] = render("crazyflie/app-config", {})
    files[f"{folder}/src/Kbuild"] = render("crazyflie/src_Kbuild", {})
    own = "controller_quadjax.c"
    files[f"{folder}/src/{own}"] = render(f"crazyflie/{own}", {})
    table = render("crazyflie/qjp_data.h", {"name": name, "words": words})
    files[f"{folder}/src/qjp_data.h"] = table
    return files | {f"{folder}/src/{file}": qjp_source(file) for file in (*LOADER, *PILOT)}
