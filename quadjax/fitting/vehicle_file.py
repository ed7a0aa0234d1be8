"""The vehicle file: read as the base of a fit, and written with what was fitted.

The keys are those of ``configs/vehicles/*.yaml``: ``name``, ``mass``, ``motor`` (every constant of
the motor-level model) and ``rate`` (the rate-level model, which a fit takes over from its base).
"""

import math
from dataclasses import dataclass
from pathlib import Path

from quadjax.config.loading import find_file, read_yaml
from quadjax.core.errors import InputError
from quadjax.core.files import write_text
from quadjax.fitting.config import BodyConfig
from quadjax.vehicle.constants import MotorConstants, RateConstants, constant_names


@dataclass(frozen=True)
class BaseVehicle:
    """A vehicle file's content."""

    name: str
    mass: float  # kg
    motor: MotorConstants
    rate: dict[str, float]


def read_vehicle(name: str, beside: Path) -> BaseVehicle:
    """Read and check a vehicle file; its place is looked for as ``find_file`` does.

    Raises:
        InputError: a missing file or key, or a value that is no number.
    """
    path = find_file(name, beside, "vehicles")
    tree = read_yaml(path)
    for key in ("motor", "rate"):
        if not isinstance(tree.get(key), dict):
            raise InputError(f"{path}: {key} is missing, expected a mapping of constants")
    motor = _numbers(path, "motor", tree["motor"], constant_names(MotorConstants))
    rate = _numbers(path, "rate", tree["rate"], constant_names(RateConstants))
    mass = _numbers(path, "", tree, ("mass",))["mass"]
    return BaseVehicle(str(tree.get("name", path.stem)), mass, MotorConstants(**motor), rate)


def with_body(base: BaseVehicle, body: BodyConfig) -> BaseVehicle:
    """The base vehicle with the config's mass, inertia and rpm range in place of its own.

    Raises:
        InputError: a value that is not positive, or not as many as expected.
    """
    motor, mass = base.motor, base.mass
    if body.mass is not None:
        mass = _positive("body.mass", [body.mass], 1)[0]
    if body.inertia is not None:
        i_xx, i_yy, i_zz = _positive("body.inertia", body.inertia, 3)
        motor = motor.replace(i_xx=i_xx, i_yy=i_yy, i_zz=i_zz)
    if body.rpm_range is not None:
        low, high = _positive("body.rpm_range", body.rpm_range, 2)
        if low >= high:
            raise InputError(f"body.rpm_range is [{low:g}, {high:g}], expected the lowest first")
        motor = motor.replace(rpm_min=low, rpm_max=high)
    return BaseVehicle(body.name, mass, motor, base.rate)


def write_vehicle(path: Path, vehicle: BaseVehicle, notes: dict[str, str], source: str) -> None:
    """Write a vehicle file, whole, with a note behind each constant that has one.

    Args:
        path: where to.
        vehicle: what to write.
        notes: by name of a motor constant, such as its standard error.
        source: what it was fitted on, for the head of the file.
    """
    quoted = vehicle.name.replace("'", "''")
    lines = [f"# {line}" for line in source.splitlines()]
    lines += [f"name: '{quoted}'", f"mass: {vehicle.mass!r}", "motor:"]
    for name in constant_names(MotorConstants):
        note = f"  # {notes[name]}" if name in notes else ""
        lines.append(f"  {name}: {float(getattr(vehicle.motor, name))!r}{note}")
    lines += ["rate:  # not fitted: the base vehicle's"]
    lines += [f"  {name}: {value!r}" for name, value in vehicle.rate.items()]
    write_text(path, "\n".join(lines) + "\n")


def _numbers(path: Path, section: str, tree: dict, names: tuple[str, ...]) -> dict[str, float]:
    prefix = f"{section}." if section else ""
    values = {}
    for name in names:
        value = tree.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"{path}: {prefix}{name} is {value!r}, expected a number")
        if not math.isfinite(value):
            raise InputError(f"{path}: {prefix}{name} is {value}, expected a finite number")
        values[name] = float(value)
    return values


def _positive(key: str, values: list[float], count: int) -> list[float]:
    if len(values) != count:
        raise InputError(f"{key} has {len(values)} values, expected {count}")
    for value in values:
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{key} is {value}, expected a positive number")
    return [float(value) for value in values]
