"""The text that ``quadjax show`` prints, and files of new tracks and vehicles."""

import contextlib
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from quadjax.config.layers import OVERRIDES, file_values
from quadjax.config.loading import load_config
from quadjax.config.reference import commented_yaml
from quadjax.config.reference import describe as describe_keys
from quadjax.config.scales import WithUnit
from quadjax.config.schema import Config
from quadjax.core.errors import InputError, close_match
from quadjax.core.files import whole_file
from quadjax.core.resources import (
    CONFIGS,
    KINDS,
    find_file,
    find_policy,
    is_run,
    policy_names,
    preset_names,
    refuse_part,
)
from quadjax.core.sections import Section, validate
from quadjax.core.yaml_files import override, parse_overrides, to_yaml
from quadjax.core.yaml_layers import read_tree_with_bases
from quadjax.evaluation.table import Table, number
from quadjax.fitting.config import FitConfig, load_fit_config
from quadjax.plant.config import PlantConfig, load_plant_config
from quadjax.policy.file import Policy
from quadjax.race.legs import against_legs, against_text, legs_of
from quadjax.race.random_track import RandomTrack, generate
from quadjax.race.track import GateSection, TrackSection
from quadjax.vehicle import vehicle_file
from quadjax.vehicle.airframe import Airframe
from quadjax.vehicle.registry import MODELS, base_model
from quadjax.vehicle.summary import summarize
from quadjax.vehicle.vehicle_file import VehicleFile

PRESET = "e2e"  # the rules for a track file without rules
Load = Callable[[str, Sequence[str]], Section]
SCHEMAS: dict[str, tuple[type[Section], Load]] = {  # kinds whose keys have descriptions
    "config": (Config, load_config),
    "plant": (PlantConfig, load_plant_config),
    "fit config": (FitConfig, load_fit_config),
}
FOLDERS = {"config": "", "track": "tracks", "vehicle": "vehicles", "plant": "plant"}
FOLDERS |= {"fit config": "fit"}  # in configs/, by kind
ANY_WIDTH = "vehicle.width=0"  # a track or a vehicle is shown alone: no gate is too narrow
COMMENT = "Source of the constants: docs/guide/race.md, Drone. A fit to logs gives better ones."


def find_kind(what: str) -> str:
    """The kind of a name or a file: config, track, vehicle, plant, fit config or policy.

    Raises:
        InputError: no such name or file.
    """
    if Path(what).suffix == ".npz" or is_run(Path(what)):
        return "policy"
    if Path(what).is_file():
        keys = _keys_of(what)
        if "gates" in keys or keys & {"models", *MODELS}:
            return "track" if "gates" in keys else "vehicle"
        return max(SCHEMAS, key=lambda kind: len(keys & {*SCHEMAS[kind][0].model_fields}))
    if files := find_files(what):
        return next(iter(files))
    if what and Path(what).is_dir():
        raise InputError(
            f"{what}: is a folder, allowed: a name that quadjax show lists, or a file: "
            f"{', '.join(FOLDERS)} or policy"
        )
    for folder in KINDS.keys() - FOLDERS.values():
        if what in preset_names(folder):
            kind, path = KINDS[folder].partition(" (")[0], CONFIGS / folder / f"{what}.yaml"
            raise InputError(f"{what}: show prints no {kind}; the file is {path}")
    refuse_part(what)
    names = [name for folder in FOLDERS.values() for name in preset_names(folder)]
    hint = close_match(what, names + policy_names())
    name = what or repr(what)
    raise InputError(f"{name}: no such name or file{hint}; quadjax show lists the names")


def _keys_of(file: str) -> set[str]:
    """The keys at the top of a file and of its bases, which may be of any kind."""
    for folder in FOLDERS.values():
        with contextlib.suppress(InputError):
            return set(read_tree_with_bases(file, folder))
    return set(read_tree_with_bases(file))


def find_files(name: str) -> dict[str, Path]:
    """The files of a name that come with the package, by kind; ``show`` prints the first."""
    stem = name.removesuffix(".yaml")
    kinds = [kind for kind, folder in FOLDERS.items() if stem in preset_names(folder)]
    files = {kind: find_file(stem, [], FOLDERS[kind]) for kind in kinds}
    return files | ({"policy": find_policy(f"{stem}.npz")} if stem in policy_names() else {})


def describe(what: str, overrides: Sequence[str] = (), model_name: str | None = None) -> str:
    """A config, a track, a vehicle, a plant, a fit config or a policy as text.

    Args:
        what: a name, or a file.
        overrides: of a config, a plant or a fit config.
        model_name: a ``module:OBJECT`` of a vehicle model; None: those in the vehicle file.

    Raises:
        InputError: no such name or file, one that cannot be read, or overrides of another kind.
    """
    kind = "vehicle" if model_name else find_kind(what)
    if kind in SCHEMAS:
        if kind == "config":
            units: WithUnit = {}
            text = commented_yaml(load_config(what, overrides, units_written=units), units)
        else:
            text = commented_yaml(SCHEMAS[kind][1](what, overrides))
        return text.rstrip("\n")
    if overrides:
        raise InputError(
            f"{overrides[0]}: {what} is a {kind}; overrides change configs, plants and fit configs"
        )
    if kind == "track":
        return track_text(read_track(what))
    if kind == "policy":
        policy, path = Policy.load(what), find_policy(what)
        network = f"network {policy.describe()}, noise {np.exp(policy.log_std).mean():.2f}"
        return f"{path}: {policy.vehicle} vehicle\n{network}\nsource: {policy.source}"
    return "\n".join(_vehicle_text(config) for config in vehicle_configs(what, model_name))


def read_track(name: str) -> TrackSection:
    """A track by its name or file."""
    one_lap = "evaluate.laps=1"  # a course has one lap
    return load_config(PRESET, [f"track.file={name}", one_lap, ANY_WIDTH]).track


def vehicle_configs(file: Path | str, model: str | None = None) -> list[Config]:
    """A checked config for each model whose constants are in a vehicle file.

    Args:
        file: next to the current folder, or in ``configs/vehicles``.
        model: only this one: ``motor``, ``rate`` or ``module:OBJECT``.

    Raises:
        InputError: an unreadable file, no known model in it, or invalid constants.
    """
    path = find_file(str(file), [Path()], "vehicles")
    models = list(file_values("vehicle", path)["vehicle"]["models"])
    names = [model] if model else [name for name in models if name in MODELS]
    if not names:
        raise InputError(f"{file}: has {', '.join(models) or 'no model'}; name its VehicleModel")
    only = [override("vehicle.file", str(path)), ANY_WIDTH]
    return [load_config("e2e", [*only, override("vehicle.model", name)]) for name in names]


def _vehicle_text(config: Config) -> str:
    """Hover, thrust, rates and time constants of a vehicle, and implausible values."""
    vehicle = config.vehicle
    summary = summarize(base_model(vehicle.model), vehicle.constants)
    warnings = [f"  warning: {text}" for text in summary.warnings]
    return "\n".join([f"{vehicle.name}, model {vehicle.model}", *summary.lines, *warnings])


def keys_text(kind: str) -> str:
    """The settings of a random track, or the data of an airframe, that ``write`` takes."""
    lines = []
    for key in describe_keys(RandomTrack if kind == "track" else Airframe):
        default = "" if key.default is None else f" ({json.dumps(key.default)})"
        lines.append(f"{key.key:<20}{key.description}{default}")
    return "\n".join(lines)


def write_vehicle(path: Path, data: Sequence[str]) -> None:
    """Write the file of a vehicle from data of its airframe, ``KEY=VALUE``.

    Raises:
        InputError: data that contradict each other, or of a drone that cannot fly; then nothing
            is written.
    """
    airframe = validate(Airframe, parse_overrides(data), OVERRIDES)
    models = {
        model: {name: float(f"{value:.6g}") for name, value in constants.items()}
        for model, constants in airframe.constants().items()
    }
    width = round(airframe.width, 4)
    drone = VehicleFile(path.stem, models, mass=airframe.mass, width=width)
    comment = f"From {' '.join(data)}\n{COMMENT}"
    with checked_file(path, vehicle_configs) as temporary:
        vehicle_file.write_vehicle(temporary, drone, comment)


def write_track(path: Path, settings: Sequence[str]) -> None:
    """Write the file of a random track from settings, ``KEY=VALUE``."""
    values = generate(validate(RandomTrack, parse_overrides(settings), OVERRIDES))
    gates = {"name": path.stem, "rules": values["rules"], "gates": values["gates"]}
    head = "# World NED: meters, z down; yaw in degrees; size: width and height in meters."
    with checked_file(path, read_track) as temporary:
        text = f"# Random track: {' '.join(settings)}\n{head}\n{to_yaml(gates)}"
        temporary.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def checked_file(path: Path, read: Callable[[str], object]) -> Iterator[Path]:
    """Yield a temporary path, which becomes ``path`` if it can be read; errors name ``path``."""
    with whole_file(path) as temporary:
        yield temporary
        try:
            read(str(temporary))
        except InputError as error:
            raise InputError(str(error).replace(str(temporary), str(path))) from None


def track_text(track: TrackSection) -> str:
    """The gates of a track as a table, with its length."""
    legs = legs_of(track)
    length, flat = np.linalg.norm(legs, axis=1), np.linalg.norm(legs[:, :2], axis=1)
    heading = np.degrees(np.arctan2(legs[:, 1], legs[:, 0]))
    turn = np.mod(np.roll(heading, -1) - heading + 180.0, 360.0) - 180.0
    slope = np.degrees(np.arctan2(-legs[:, 2], flat))
    # No turn before or after a leg straight up or down, nor at the end of a course.
    turns = (flat > 0.01) & (np.roll(flat, -1) > 0.01)
    turns[-1] &= track.closed
    against = against_legs(track)
    rows = []
    for index, gate in enumerate(track.gates):
        x, y, z = gate.position
        angles = (gate.yaw_deg, slope[index], turn[index] if turns[index] else np.nan)
        yaw, pitch, bend = ("-" if np.isnan(x) else str(round(x)) for x in angles)
        place = [number(value) for value in (x, y, -z)]
        leg = number(length[index])
        yaw += "*" if index + 1 in against else ""
        rows.append([str(index + 1), *place, yaw, leg, pitch, bend, _opening(gate)])
    kind = "a lap" if track.closed else "a course"
    count = f"{len(legs)} gate{'s' if len(legs) > 1 else ''}"
    head = f"{track.name}: {count}, {kind} of {length.sum():.1f} m between centers"
    titles = ["gate", "north", "east", "height", "yaw", "leg", "slope", "turn", "opening"]
    notes = ["meters and degrees; leg: from the gate before; turn: to the one after"]
    if text := against_text(track):
        notes.append(f"* {text}")
    return f"{head}\n{Table(titles, rows, notes).format()}"


def _opening(gate: GateSection) -> str:
    """Size, shape and tilt of a gate."""
    width, height = gate.size
    size = f"{width:g} x {height:g}" if gate.shape == "rectangle" else f"{width:g} {gate.shape}"
    tilts = {"pitch": gate.pitch_deg, "roll": gate.roll_deg}
    return ", ".join([size, *(f"{name} {value:g} deg" for name, value in tilts.items() if value)])
