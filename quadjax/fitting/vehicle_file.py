"""The vehicle file as base and result of a fit.

Keys as in ``configs/vehicles/*.yaml``: ``name``, ``mass`` (optional), ``motor`` (constants of the
motor-level model), and constants of other models, which a fit copies.
"""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

from quadjax.core.errors import InputError
from quadjax.core.files import write_text
from quadjax.core.yaml_files import find_file, read_yaml
from quadjax.fitting.config import BodyConfig
from quadjax.vehicle.constants import MotorConstants, constant_names


@dataclass(frozen=True)
class BaseVehicle:
    """Content of a vehicle file."""

    name: str
    mass: float | None  # kg
    motor: MotorConstants
    others: dict[str, dict[str, float]]  # constants of other models


def read_vehicle(name: str, folder: Path = Path()) -> BaseVehicle:
    """Read a vehicle file, found relative to ``folder`` or in ``configs/vehicles``.

    Raises:
        InputError: a missing file or key, or a value that is not a finite number.
    """
    path = find_file(name, folder, "vehicles")
    tree = read_yaml(path)
    if not isinstance(tree.get("motor"), dict):
        raise InputError(f"{path}: motor is missing, expected a mapping of constants")
    motor = {key: _number(path, "motor", tree, key) for key in constant_names(MotorConstants)}
    others = {
        model: {key: _number(path, model, tree, key) for key in constants}
        for model, constants in tree.items()
        if isinstance(constants, dict) and model != "motor"
    }
    mass = _number(path, "", {"": tree}, "mass") if tree.get("mass") is not None else None
    return BaseVehicle(str(tree.get("name", path.stem)), mass, MotorConstants(**motor), others)


def with_body(base: BaseVehicle, body: BodyConfig) -> BaseVehicle:
    """The base vehicle with the config's name, mass, inertia and rpm range.

    Raises:
        InputError: no inertia.
    """
    motor, mass = base.motor, body.mass
    if body.inertia is None:
        raise InputError(
            "body.inertia is null; logs do not determine it, and all moments are proportional to "
            f"it: set [xx, yy, zz] in kg m^2, or base for that of {base.name}"
        )
    if body.inertia == "base":
        mass = base.mass if mass is None else mass
    else:
        motor = motor.replace(**dict(zip(("i_xx", "i_yy", "i_zz"), body.inertia, strict=True)))
    if body.rpm_range is not None:
        motor = motor.replace(rpm_min=body.rpm_range[0], rpm_max=body.rpm_range[1])
    return dataclasses.replace(base, name=body.name, mass=mass, motor=motor)


def write_vehicle(
    path: Path, vehicle: BaseVehicle, notes: dict[str, dict[str, str]], source: str
) -> None:
    """Write a vehicle file, with a comment after each constant that has a note.

    Args:
        path: of the file.
        vehicle: its content.
        notes: by model and constant, such as its standard error.
        source: comment at the head of the file.
    """
    quoted = vehicle.name.replace("'", "''")
    lines = [f"# {line}" for line in source.splitlines()] + [f"name: '{quoted}'"]
    lines += [f"mass: {vehicle.mass!r}"] if vehicle.mass is not None else []
    lines.append("motor:")
    for name in constant_names(MotorConstants):
        value = float(getattr(vehicle.motor, name))
        lines.append(_constant_line(name, value, notes.get("motor", {})))
    for model, constants in vehicle.others.items():
        known = notes.get(model, {})
        lines.append(f"{model}:" + ("" if known else "  # not fitted: the base vehicle's"))
        lines += [_constant_line(name, value, known) for name, value in constants.items()]
    write_text(path, "\n".join(lines) + "\n")


def _constant_line(name: str, value: float, notes: dict[str, str]) -> str:
    return f"  {name}: {value!r}" + (f"  # {notes[name]}" if name in notes else "")


def _number(path: Path, section: str, tree: dict, name: str) -> float:
    value = tree[section].get(name)
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not math.isfinite(value):
        raise InputError(
            f"{path}: {f'{section}.{name}'.lstrip('.')} is {value!r}, expected a finite number"
        )
    return float(value)
