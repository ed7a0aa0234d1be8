"""Files of autopilots around a ``.qjp`` policy: a module of PX4, a controller of the Crazyflie."""

import dataclasses

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.fixed import FixedNetwork
from quadjax.export.qjp.emit import FOLDER, LOADER, qjp_source
from quadjax.export.race_tables import RaceTables
from quadjax.export.render import render
from quadjax.export.targets import CRAZYFLIE, PX4, QJP, check_model
from quadjax.race.observations import DISTURBANCES

PX4_FOLDER, CRAZYFLIE_FOLDER = "px4", "crazyflie"
PX4_MODULE = f"{PX4_FOLDER}/src/modules/quadjax_policy"  # in EXTERNAL_MODULES_LOCATION
PX4_FILES = ("CMakeLists.txt", "Kconfig", "QuadjaxPolicy.hpp", "QuadjaxPolicy.cpp")
PILOT = ("qjp_pilot.h", "qjp_pilot.c")


@dataclasses.dataclass(frozen=True)
class Runtime:
    """The C of an export that flies a ``.qjp`` file."""

    folder: str  # of the export
    names: tuple[str, ...]  # its C sources
    options: tuple[str, ...]  # that the autopilot compiles it with
    words: str  # where they are on board
    glue: str = ""  # the file that needs the autopilot's headers
    rotor_speeds: bool = True  # the autopilot measures them

    @property
    def has_pilot(self) -> bool:
        """Whether the loader is called by ``qjp_pilot.c``, or by the user's firmware."""
        return PILOT[1] in self.names

    @property
    def files(self) -> tuple[str, ...]:
        """Paths of the C sources in the export."""
        return tuple(f"{self.folder}/{name}" for name in self.names)


_LOADED = tuple(name for name in LOADER if name.endswith(".c"))
_PILOTED = (*_LOADED, PILOT[1])
PX4_WORDS = "in RAM, of 196,608 B that are reserved"
_STATIC = ("-DQJP_STATIC=1",)
RUNTIMES = {
    QJP: Runtime(FOLDER, _LOADED, (), "where the firmware puts them"),
    PX4: Runtime(PX4_MODULE, _PILOTED, _STATIC, PX4_WORDS, "QuadjaxPolicy.cpp"),
    CRAZYFLIE: Runtime(
        f"{CRAZYFLIE_FOLDER}/src",
        _PILOTED,
        _STATIC,
        "in flash",
        "controller_quadjax.c",
        rotor_speeds=False,
    ),
}
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


def words_header(name: str, data: bytes) -> str:
    """The words of a ``.qjp`` file as a C table, ``qjp_data``."""
    words = np.frombuffer(data, "<i4")
    return render("crazyflie/qjp_data.h", {"name": name, "words": words})


def emit_crazyflie(
    name: str, data: bytes, network: FixedNetwork, race: RaceTables, time_step: float
) -> dict[str, str]:
    """The Crazyflie's out-of-tree app, by path, with the policy's file as a table."""
    check_crazyflie(network, race, time_step)
    folder = CRAZYFLIE_FOLDER
    files = {f"{folder}/{file}": render(f"crazyflie/{file}", {}) for file in ("Kbuild", "Makefile")}
    files[f"{folder}/app-config"] = render("crazyflie/app-config", {})
    files[f"{folder}/src/Kbuild"] = render("crazyflie/src_Kbuild", {})
    own = "controller_quadjax.c"
    files[f"{folder}/src/{own}"] = render(f"crazyflie/{own}", {})
    files[f"{folder}/src/qjp_data.h"] = words_header(name, data)
    return files | {f"{folder}/src/{file}": qjp_source(file) for file in (*LOADER, *PILOT)}
