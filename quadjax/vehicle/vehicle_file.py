"""Vehicle files: a drone's name, its model and the constants of one or several models."""

from collections.abc import Collection
from pathlib import Path

from quadjax.core.errors import InputError
from quadjax.core.yaml_files import Tree, short

KEYS = ("name", "mass", "width", "fitted_speed", "model", "rotors")  # in addition to the models
ROTORS = ("front_left", "front_right", "rear_right", "rear_left")  # the order of Rotors
TURNING = {"ccw": 1.0, "cw": -1.0}  # seen from above


def vehicle_values(path: Path, tree: Tree) -> Tree:
    """The keys of a vehicle file as those of the config's section ``vehicle``.

    A constant that is a list of four has one value for each rotor, in the order of the file's key
    ``rotors``; it becomes four constants, whose names end in 1 to 4, in the order of ``ROTORS``.

    Args:
        path: the file, for messages.
        tree: its keys: ``KEYS``, and a mapping of constants for each model.

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
    own: Tree = {
        key: tree[key] for key in ("name", "width", "fitted_speed", "model") if key in tree
    }
    return {"name": path.stem, **own, "models": models}


def _with_rotors(values: Tree, order: list[str], where: str) -> Tree:
    found: Tree = {}
    for key, value in values.items():
        if not isinstance(value, list):
            found.setdefault(key, value)
            continue
        if len(value) != len(ROTORS):
            raise InputError(f"{where}.{key} is {short(value)}, allowed: one value for each rotor")
        for place, item in zip(order, value, strict=True):
            if key == "turning" and item not in TURNING:
                raise InputError(f"{where}.turning is {short(value)}, allowed: cw or ccw for each")
            number = TURNING[item] if key == "turning" else item
            name = f"{key}{ROTORS.index(place) + 1}"
            found[name] = values.get(name, number)  # a name with a rotor's number has precedence
    return found


def for_each_rotor(values: Tree, names: Collection[str]) -> Tree:
    """Constants of a model, where a name without a rotor's number stands for all four rotors.

    Args:
        values: constants by name.
        names: of all constants of the model.
    """
    found: Tree = {}
    for key, value in values.items():
        four = [f"{key}{index}" for index in range(1, len(ROTORS) + 1)]
        if key not in names and set(four) <= set(names):
            found |= {name: value for name in four if name not in values}
        else:
            found[key] = value
    return found
