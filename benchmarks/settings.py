"""The numbers that a row of results depends on: what its settings resolve to, and their hash."""

import functools
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pydantic

import quadjax
from quadjax.core.errors import InputError, short
from quadjax.core.provenance import hash_file
from quadjax.core.resources import PRETRAINED
from quadjax.plant.config import load_plant_config
from quadjax.plant.plant import nominal_vehicle
from quadjax.training.result import Run

Tree = dict[str, Any]
SETTINGS = ("config", "race", "plant", "policy")  # keys of a row
RACE = (  # sections that flights of a given policy depend on
    *("vehicle", "track", "observation", "rules", "start", "disturbance", "battery"),
    *("randomization", "evaluate"),
)
NO_EFFECT = {  # on training, race or flights
    *("name", "seed", "vehicle.name", "vehicle.file", "vehicle.fitted_speed", "track.name"),
    *("track.file", "run.devices", "run.checkpoint_seconds", "run.tensorboard"),
    *("run.compilation_cache", "evaluate.runs", "evaluate.best_known_lap"),
}
ABSENT = "absent"


def settings(row: Tree) -> dict[str, Tree]:
    """The present numbers of each setting of a row."""
    words = {key: row[key] for key in SETTINGS if key in row}
    return {key: _resolve(key, *([x] if isinstance(x, str) else x)) for key, x in words.items()}


def check_run(run: Run, row: Tree) -> None:
    """Compare the config of a run with that of the row.

    Raises:
        InputError: a number differs.
    """
    for key, (own, now) in differences(plain(run.config), settings(row)["config"]).items():
        raise InputError(f"{run.folder}: {key} is {short(own)}, in {row['name']} {short(now)}")


@functools.cache
def _resolve(setting: str, first: str, *words: str) -> Tree:
    if setting == "policy":
        if (digest := hash_file(PRETRAINED / first)) is None:
            raise InputError(f"policy: {first}: no such file in quadjax/pretrained")
        return {"sha256": digest}
    if setting == "plant":
        plant = load_plant_config(first, words)
        drone = nominal_vehicle(plant)
        return plain(plant) | {"vehicle": {"mass": drone.mass, "models": dict(drone.models)}}
    tree = plain(quadjax.load(first, words))
    return tree if setting == "config" else {key: tree[key] for key in RACE if key in tree}


def plain(section: pydantic.BaseModel) -> Tree:
    """The values of a config that have an effect.

    A shipped ``.npz`` file is its SHA-256; another one its name, as it may not be there. A key that
    is null is left out: null is off, so that a new key at null is the same setting.
    """

    def cleaned(value: Any, at: str) -> Any:
        if isinstance(value, dict):
            kept = {k: x for k, x in value.items() if x is not None and at + k not in NO_EFFECT}
            return {key: cleaned(item, f"{at}{key}.") for key, item in kept.items()}
        if isinstance(value, list):
            return [cleaned(item, at) for item in value]
        if isinstance(value, str) and value.endswith(".npz"):
            name = Path(value).name
            return hash_file(PRETRAINED / name) or name
        return value

    return cleaned(section.model_dump(mode="json", by_alias=True), "")


def hash_of(tree: Tree) -> str:
    """16 hexadecimal digits of the SHA-256 of numbers; floats are written by their ``repr``."""
    return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()[:16]


def differences(then: Tree, now: Tree) -> dict[str, tuple[Any, Any]]:
    """Former and present value of each dotted key that differs; ``ABSENT`` where there is none."""
    old, new = dict(_flat(then)), dict(_flat(now))
    keys = dict.fromkeys([*old, *new])
    pairs = {key: (old.get(key, ABSENT), new.get(key, ABSENT)) for key in keys}
    return {key: (a, b) for key, (a, b) in pairs.items() if a != b}


def _flat(node: Any, at: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values; lists of mappings have their index as a key."""
    if isinstance(node, list) and any(isinstance(item, dict) for item in node):
        node = {str(index): item for index, item in enumerate(node)}
    if isinstance(node, dict) and node:
        for key, value in node.items():
            yield from _flat(value, f"{at}.{key}" if at else key)
    else:
        yield at, node
