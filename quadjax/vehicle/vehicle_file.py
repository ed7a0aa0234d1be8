"""Vehicle files: a drone's name, its model and the constants of one or several models."""

from collections.abc import Collection, Mapping
from pathlib import Path

from quadjax.core.errors import InputError, short
from quadjax.core.yaml_files import Tree, to_yaml
from quadjax.vehicle.constants import rotor_names

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
    keys = {key: tree[key] for key in KEYS if key in tree and key not in ("mass", "rotors")}
    return {"name": path.stem, **keys, "models": models}


def _with_rotors(values: Tree, order: list[str], where: str) -> Tree:
    numbers: Tree = {}
    for key, value in values.items():
        if not isinstance(value, list):
            numbers.setdefault(key, value)
            continue
        if len(value) != len(ROTORS):
            raise InputError(f"{where}.{key} is {short(value)}, allowed: one value for each rotor")
        for place, item in zip(order, value, strict=True):
            if key == "turning" and item not in TURNING:
                raise InputError(f"{where}.turning is {short(value)}, allowed: cw or ccw for each")
            number = TURNING[item] if key == "turning" else item
            name = rotor_names(key)[ROTORS.index(place)]
            numbers[name] = values.get(name, number)  # a name with a rotor's number has precedence
    return numbers


def for_each_rotor(values: Tree, names: Collection[str]) -> Tree:
    """Constants of a model, where a name without a rotor's number stands for all four rotors.

    Args:
        values: constants by name.
        names: of all constants of the model.
    """
    expanded: Tree = {}
    for key, value in values.items():
        four = rotor_names(key)
        if key not in names and set(four) <= set(names):
            expanded |= {name: value for name in four if name not in values}
        else:
            expanded[key] = value
    return expanded


def vehicle_text(
    keys: Tree,
    models: Mapping[str, Mapping[str, float]],
    comment: str,
    notes: Mapping[str, Mapping[str, str]] | None = None,
) -> str:
    """The text of a vehicle file; ``vehicle_values`` reads it.

    Args:
        keys: those of ``KEYS`` that the file has.
        models: constants by model and name; those of four rotors are written as a list.
        comment: at the head of the file.
        notes: on constants, by model and name; a model that is not in them was not fitted.
    """
    lines = [*(f"# {line}" for line in comment.splitlines()), *to_yaml(keys).splitlines()]
    if any(map(_rotor_stems, models.values())):
        lines.append(f"rotors: [{', '.join(ROTORS)}]")
    for model, values in models.items():
        comments = {} if notes is None else notes.get(model, {})
        fitted = notes is None or model in notes
        lines.append(f"{model}:" + ("" if fitted else "  # not fitted: the base vehicle's"))
        lines += _constant_lines(values, comments)
    return "\n".join(lines) + "\n"


def _rotor_stems(values: Mapping[str, float]) -> set[str]:
    """Names, without the rotor's number, of the constants of which all four rotors have one."""
    return {name[:-1] for name in values if set(rotor_names(name[:-1])) <= set(values)}


def _constant_lines(values: Mapping[str, float], notes: Mapping[str, str]) -> list[str]:
    words = {number: word for word, number in TURNING.items()}
    stems, lines = _rotor_stems(values), []
    for name, value in values.items():
        names: tuple[str, ...] = (name,)
        stem, text = name[:-1], repr(value)
        if stem in stems:
            names = rotor_names(stem)
            items = (values[rotor] for rotor in names)
            text = ", ".join(words[x] if stem == "turning" else repr(x) for x in items)
            text = f"[{text}]"
        if name == names[0]:
            note = ", ".join(notes[rotor] for rotor in names if rotor in notes)
            key = stem if stem in stems else name
            lines.append(f"  {key}: {text}" + (f"  # {note}" if note else ""))
    return lines
