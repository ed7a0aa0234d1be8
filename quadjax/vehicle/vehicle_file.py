"""Vehicle files: a drone's name, its model and the constants of one or several models."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from quadjax.core.errors import InputError, short
from quadjax.core.files import write_text
from quadjax.core.resources import find_file
from quadjax.core.yaml_files import Tree, to_yaml
from quadjax.core.yaml_layers import read_tree_with_bases
from quadjax.vehicle.constants import (
    constant_names,
    declarations,
    from_values,
    rotor_names,
    values_of,
)
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.racing import RacingConstants
from quadjax.vehicle.registry import MODELS
from quadjax.vehicle.residual import finite_number

KEYS = ("name", "mass", "width", "fitted_speed", "model", "rotors")  # in addition to the models
ROTORS = ("front_left", "front_right", "rear_right", "rear_left")  # the order of Rotors
TURNING = {"ccw": 1.0, "cw": -1.0}  # seen from above
UNITS = {"mass": "kg", "width": "m", "fitted_speed": "m/s"}  # of the numbers that are no constants


@dataclass(frozen=True)
class VehicleFile:
    """The content of a vehicle file.

    Attributes:
        name: of the drone.
        models: constants by model and name.
        model: that a race uses; None is that of the race.
        mass: kg; None if not known, as the other numbers.
        width: m, from tip to tip of diagonally opposite propellers.
        fitted_speed: m/s, the highest of the flights that the constants are fitted to.
        path: of the file, for messages.
    """

    name: str
    models: dict[str, dict[str, float]]
    model: str | None = None
    mass: float | None = None
    width: float | None = None
    fitted_speed: float | None = None
    path: Path = field(default=Path(), compare=False)

    def constants(self, model: str) -> Any:
        """The constants of a model of ``quadjax.vehicle.registry``, as floats.

        Raises:
            InputError: a constant that the file does not have, or rotors that cannot fly.
        """
        if model not in self.models:
            raise InputError(f"{self.path}: {model} is missing, expected a mapping of constants")
        kind = MODELS[model].constants
        values = for_each_rotor(self.models[model], constant_names(kind))
        numbers = {
            key: finite_number(self.path, values, key, f"{model}.") for key in constant_names(kind)
        }
        if reason := MODELS[model].dependent_axes(constants := from_values(kind, numbers)):
            raise InputError(f"{self.path}: {model}: {reason}")
        return constants

    @property
    def motor(self) -> MotorConstants:
        """The constants of the model ``motor``."""
        return self.constants("motor")

    @property
    def racing(self) -> RacingConstants:
        """The constants of the model ``racing``."""
        return self.constants("racing")

    def with_constants(self, model: str, constants: Any) -> Self:
        """The drone with other constants of one model, a dataclass or numbers by name."""
        values = constants if isinstance(constants, Mapping) else values_of(constants)
        numbers = {name: float(value) for name, value in values.items()}
        return replace(self, models=self.models | {model: numbers})


def read_vehicle(name: str, folder: Path = Path()) -> VehicleFile:
    """Read a vehicle file, found in the current folder, in ``folder`` or in ``configs/vehicles``.

    Raises:
        InputError: a missing file, or a value that is not a finite number.
    """
    path = find_file(name, [Path(), folder], "vehicles")
    tree = read_tree_with_bases(path, "vehicles")
    values = vehicle_values(path, tree) | {"mass": tree.get("mass")}
    models = {
        model: {key: finite_number(path, constants, key, f"{model}.") for key in constants}
        for model, constants in values["models"].items()
    }
    present = [key for key in UNITS if values.get(key) is not None]
    numbers = {key: finite_number(path, values, key) for key in present}
    model = str(values["model"]) if "model" in values else None
    return VehicleFile(str(values["name"]), models, model, **numbers, path=path)


def write_vehicle(
    path: Path,
    vehicle: VehicleFile,
    comment: str,
    notes: Mapping[str, Mapping[str, str]] | None = None,
) -> None:
    """Write a vehicle file with a comment at its head.

    ``notes`` are on constants, by model and name; a model that is not in them was not fitted.
    """
    keys = {key: getattr(vehicle, key) for key in KEYS if hasattr(vehicle, key)}
    present = {key: value for key, value in keys.items() if value is not None}
    write_text(path, _text(present, vehicle.models, comment, notes))


def vehicle_values(path: Path, tree: Tree) -> Tree:
    """The keys of a vehicle file as those of the config's section ``vehicle``.

    A constant that is a list of four has one value for each rotor, in the order of the file's key
    ``rotors``; it becomes four constants, whose names end in 1 to 4, in the order of ``ROTORS``.

    Raises:
        InputError: a value of the wrong kind.
    """
    order = tree.get("rotors", list(ROTORS))
    if not isinstance(order, list) or sorted(map(str, order)) != sorted(ROTORS):
        allowed = f"{', '.join(ROTORS)} in any order"
        raise InputError(f"{path}: rotors is {short(order)}, allowed: {allowed}")
    models: Tree = {}
    for key, value in tree.items():
        if key in KEYS:
            continue
        if not isinstance(value, dict):
            raise InputError(
                f"{path}: {key} is {short(value)}; allowed: {', '.join(KEYS)}, and the constants "
                "of each model as a mapping (motor, rate, ..)"
            )
        models[key] = _with_rotors(value, order, f"{path}: {key}")
    keys = {key: tree[key] for key in KEYS if key in tree and key not in ("mass", "rotors")}
    return {"name": path.stem, **keys, "models": models}


def _with_rotors(values: Tree, order: list[str], where: str) -> Tree:
    numbers: Tree = {}
    for key, value in values.items():
        if not isinstance(value, list):
            continue
        if len(value) != len(ROTORS):
            raise InputError(f"{where}.{key} is {short(value)}, allowed: one value for each rotor")
        if key == "turning" and not all(isinstance(x, str) and x in TURNING for x in value):
            raise InputError(f"{where}.turning is {short(value)}, allowed: cw or ccw for each")
        for place, item in zip(order, value, strict=True):
            name = rotor_names(key)[ROTORS.index(place)]
            numbers[name] = TURNING[item] if key == "turning" else item
    # A name with a rotor's number has precedence.
    return numbers | {key: x for key, x in values.items() if not isinstance(x, list)}


def for_each_rotor(values: Tree, names: Collection[str]) -> Tree:
    """Constants by name, where a name without a rotor's number stands for all four rotors.

    ``names`` are those of all constants of the model.
    """
    shared = [key for key in values if key not in names and set(rotor_names(key)) <= set(names)]
    four = {name: values[key] for key in shared for name in rotor_names(key)}
    return four | {key: value for key, value in values.items() if key not in shared}


def _text(
    keys: Tree,
    models: Mapping[str, Mapping[str, float]],
    comment: str,
    notes: Mapping[str, Mapping[str, str]] | None,
) -> str:
    """The text of a vehicle file, with the constants of four rotors as a list."""
    lines = [f"# {line}" for line in comment.splitlines()]
    for key, line in zip(keys, to_yaml(keys).splitlines(), strict=True):
        lines.append(f"{line}  # {UNITS[key]}" if key in UNITS else line)
    tables = {model: _names_by_key(values) for model, values in models.items()}
    if any(len(names) > 1 for table in tables.values() for names in table.values()):
        lines.append(f"rotors: [{', '.join(ROTORS)}]")
    words = {number: word for word, number in TURNING.items()}
    for model, values in models.items():
        comments = {} if notes is None else notes.get(model, {})
        fitted = notes is None or model in notes
        declared = declarations(MODELS[model].constants) if model in MODELS else {}
        lines.append(f"{model}:" + ("" if fitted else "  # not fitted: the base vehicle's"))
        for key, names in tables[model].items():
            items = [words[values[x]] if key == "turning" else repr(values[x]) for x in names]
            text = f"[{', '.join(items)}]" if len(items) > 1 else items[0]
            units = [declared[names[0]].unit] if names[0] in declared else []
            note = ", ".join(filter(None, units + [comments.get(name, "") for name in names]))
            lines.append(f"  {key}: {text}" + (f"  # {note}" if note else ""))
    return "\n".join(lines) + "\n"


def _names_by_key(values: Mapping[str, float]) -> dict[str, tuple[str, ...]]:
    """The names of constants by their keys in a file: one, or those of the four rotors."""
    keys: dict[str, tuple[str, ...]] = {}
    for name in values:
        four = rotor_names(name[:-1])
        keys |= {name[:-1]: four} if set(four) <= set(values) else {name: (name,)}
    return keys
