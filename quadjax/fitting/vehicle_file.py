"""The vehicle file as base and result of a fit.

Keys as in ``configs/vehicles/*.yaml``: ``name``, ``mass`` (optional), ``motor`` (constants of the
motor-level model), and ``KEPT`` and constants of other models, which a fit copies.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from quadjax.core.errors import InputError
from quadjax.core.files import write_text
from quadjax.core.resources import find_file
from quadjax.core.yaml_files import Tree, read_tree_with_bases
from quadjax.fitting.config import BodyConfig
from quadjax.vehicle.constants import constant_names, values_of
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.vehicle_file import vehicle_text, vehicle_values

KEPT = ("width", "fitted_speed", "model")
MOTOR = constant_names(MotorConstants)


@dataclass(frozen=True)
class BaseVehicle:
    """Content of a vehicle file."""

    name: str
    mass: float | None  # kg
    motor: MotorConstants
    others: dict[str, dict[str, float]]  # constants of other models
    keys: Tree = field(default_factory=dict)  # those of KEPT that the file has


def vehicle_tree(name: str, folder: Path = Path()) -> tuple[Path, Tree]:
    """A vehicle file, found relative to ``folder`` or in ``configs/vehicles``, and its values.

    Raises:
        InputError: a missing file, or a value of the wrong kind.
    """
    path = find_file(name, [folder], "vehicles")
    tree = read_tree_with_bases(path)
    mass = {"mass": tree["mass"]} if tree.get("mass") is not None else {}
    return path, vehicle_values(path, tree) | mass


def kept_keys(path: Path, values: Tree) -> Tree:
    """The keys ``KEPT`` of a vehicle file.

    Raises:
        InputError: a value of the wrong kind.
    """
    found = {key: number(path, values, key) for key in KEPT[:2] if values.get(key) is not None}
    return found | ({"model": str(values["model"])} if "model" in values else {})


def read_vehicle(name: str, folder: Path = Path()) -> BaseVehicle:
    """Read a vehicle file, found relative to ``folder`` or in ``configs/vehicles``.

    Raises:
        InputError: a missing file or key, or a value that is not a finite number.
    """
    path, values = vehicle_tree(name, folder)
    models = values["models"]
    if "motor" not in models:
        raise InputError(f"{path}: motor is missing, expected a mapping of constants")
    motor = {key: number(path, models["motor"], key, "motor.") for key in MOTOR}
    others = {
        model: {key: number(path, constants, key, f"{model}.") for key in constants}
        for model, constants in models.items()
        if model != "motor"
    }
    mass = number(path, values, "mass") if "mass" in values else None
    keys = kept_keys(path, values)
    return BaseVehicle(str(values["name"]), mass, MotorConstants(**motor), others, keys)


def with_body(base: BaseVehicle, body: BodyConfig) -> BaseVehicle:
    """The base vehicle with the config's name, mass, inertia and rpm range.

    Mass and width of the base vehicle are those of a drone with its inertia.

    Raises:
        InputError: no inertia.
    """
    motor, mass, keys = base.motor, body.mass, dict(base.keys)
    if body.inertia is None:
        raise InputError(
            "body.inertia is null; logs do not determine it, and all moments are proportional to "
            f"it: set [xx, yy, zz] in kg m^2, or base for that of {base.name}"
        )
    if body.inertia == "base":
        mass = base.mass if mass is None else mass
    else:
        keys.pop("width", None)
        motor = motor.replace(**dict(zip(("i_xx", "i_yy", "i_zz"), body.inertia, strict=True)))
    if body.rpm_range is not None:
        motor = motor.replace(rpm_min=body.rpm_range[0], rpm_max=body.rpm_range[1])
    return dataclasses.replace(base, name=body.name, mass=mass, motor=motor, keys=keys)


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
    mass = {} if vehicle.mass is None else {"mass": vehicle.mass}
    models = {"motor": {name: float(x) for name, x in values_of(vehicle.motor).items()}}
    keys = {"name": vehicle.name, **mass, **vehicle.keys}
    write_text(path, vehicle_text(keys, models | vehicle.others, source, {"motor": {}, **notes}))


def number(path: Path, values: Mapping[str, object], name: str, section: str = "") -> float:
    """A finite number of a vehicle file.

    Args:
        path: of the file, for messages.
        values: numbers by name.
        name: of the number.
        section: before the name in messages.

    Raises:
        InputError: no such number.
    """
    value = values.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{path}: {section}{name} is {value!r}, expected a finite number")
    return float(value)
