"""``quadjax show``."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from quadjax.cli.options import Flag, Overrides, Picture, check_writable
from quadjax.cli.output import wrote
from quadjax.core.errors import InputError, close_match
from quadjax.core.interruptions import loading
from quadjax.core.resources import (
    CONFIGS,
    find_policy,
    policy_names,
    preset_names,
)

if TYPE_CHECKING:
    from quadjax.config.schema import Gate, Track

PRESET = "e2e"  # whose rules check a track that has none of its own
KINDS = {  # folders of configs
    "presets": "",
    "parts of presets (+NAME; with a prefix e2e_ or indi_ those of that preset)": "parts",
    "tracks": "tracks",
    "vehicles": "vehicles",
}
COMMENT = "docs/guide/vehicle.md has the formulas. Fit flight logs for better constants."


def show(
    what: Annotated[str | None, Parameter(name="WHAT")] = None,
    /,
    *words: Overrides,
    write: Literal["track", "vehicle"] | None = None,
    overwrite: Flag = False,
    figure: Picture = None,
    model: Annotated[str | None, Parameter(metavar="module:OBJECT")] = None,
) -> None:
    """List presets, parts, policies, tracks and vehicles, or print one of them.

    Without WHAT, everything that comes with the package is listed by name.
    WHAT is a name or a file; what it contains decides what is printed:

    - a config: every key with its value and description, after the overrides;
    - a track: the gates, length and slope of the leg to each, the turn there;
    - a vehicle: hover command, thrust-to-weight ratio, largest body rates and
      time constants of each model in the file, and implausible values;
    - a policy (FILE.npz, or the name of a shipped one): network and source.

    With --write, the file WHAT is written first: a random track from settings
    such as seed and gates, or a vehicle from data of its airframe such as mass
    and wheelbase. Without WHAT, --write lists these keys.

    Example: quadjax show mine.yaml --write track seed=3 gates=12 --figure mine.png

    Args:
        what: The name or the file.
        write: Write the file WHAT from the settings KEY=VALUE.
        overwrite: Replace existing files.
        figure: Draw the track from two sides.
        model: Your own VehicleModel (default: those in the vehicle file).
    """
    if what is None:
        print(_keys_of(write) if write else _listing())
        return
    if figure is not None:
        check_writable(figure, overwrite=overwrite)
    if write is not None:
        check_writable(Path(what), (".yaml",), overwrite)
        (_write_track if write == "track" else _write_vehicle)(Path(what), words)
        wrote(what)
        words = ()
    kind = write or ("vehicle" if model else _kind_of(what))
    if figure is not None and kind != "track":
        raise InputError(f"--figure has no effect: {what} is a {kind}, not a track")
    if words and kind != "config":
        raise InputError(f"{words[0]}: {what} is a {kind}; overrides change a config")
    if kind == "config":
        _print_config(what, words)
    elif kind == "track":
        _print_track(what, figure)
    elif kind == "vehicle":
        _print_vehicle(what, model)
    else:
        _print_policy(what)


def _kind_of(what: str) -> str:
    """Whether a name or a file is a config, a track, a vehicle or a policy."""
    with loading():
        from quadjax.core.yaml_files import read_tree_with_bases
        from quadjax.vehicle.registry import MODELS

    if Path(what).suffix == ".npz":
        return "policy"
    if not Path(what).is_file():
        kinds = {"config": "", "track": "tracks", "vehicle": "vehicles"}
        names = {kind: preset_names(folder) for kind, folder in kinds.items()}
        names["policy"] = policy_names()
        for kind, shipped in names.items():
            if Path(what).with_suffix("").name in shipped:
                return kind
        hint = close_match(what, [name for shipped in names.values() for name in shipped])
        raise InputError(f"{what}: no such name or file{hint}; quadjax show lists the names")
    tree = read_tree_with_bases(what)
    if "gates" in tree:
        return "track"
    return "vehicle" if {"models", *MODELS} & set(tree) else "config"


def _keys_of(kind: str) -> str:
    """The settings of a random track, or the data of an airframe."""
    with loading():
        from quadjax.config.reference import describe
        from quadjax.race.random_track import RandomTrack
        from quadjax.vehicle.airframe import Airframe

    keys = describe(RandomTrack if kind == "track" else Airframe)
    return "\n".join(f"{key.key:<20}{key.description} ({key.default})" for key in keys)


def _listing() -> str:
    """Names and descriptions of what comes with the package."""
    lines = []
    for kind, folder in KINDS.items():
        names = preset_names(folder)
        width = max(map(len, names))
        lines += [f"{kind}:"]
        for name in names:
            start = f"  {name:<{width}}  "
            text = _description(CONFIGS / folder / f"{name}.yaml")
            lines.append(textwrap.fill(start + text, 79, subsequent_indent=" " * len(start)))
        lines.append("")
    policies = textwrap.fill(", ".join(policy_names()), 77)
    return "\n".join([*lines, "policies:", textwrap.indent(policies, "  ")])


def _description(path: Path) -> str:
    """The first sentence of the comment at the top of a file."""
    text = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        text.append(line.lstrip("# "))
    return " ".join(text).split(". ")[0].removesuffix(".")


def _print_config(name: str, overrides: Sequence[str]) -> None:
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.config.reference import commented_yaml

    print(commented_yaml(load_config(name, overrides)), end="")


def _print_policy(name: str) -> None:
    with loading():
        from quadjax.policy.file import Policy

    policy = Policy.load(find_policy(name))
    sizes = [policy.layers[0][0].shape[0], *(len(bias) for _, bias in policy.layers)]
    print(f"{find_policy(name)}: {policy.vehicle} vehicle")
    print(f"network {'-'.join(map(str, sizes))}, {policy.activation}")
    print(f"source: {policy.source}")


def _print_vehicle(name: str, model_name: str | None) -> None:
    with loading():
        from quadjax.config.loading import vehicle_configs
        from quadjax.vehicle import registry
        from quadjax.vehicle.summary import describe, summarize, warnings

    for config in vehicle_configs(name, model_name):
        vehicle, model = config.vehicle, registry.model(config.vehicle.model)
        summary = summarize(model, vehicle.constants)
        print(f"{vehicle.name}, model {vehicle.model}")
        print(describe(model, summary))
        for text in warnings(model, summary, vehicle.constants):
            print(f"  warning: {text}")


def _print_track(name: str, figure: Path | None) -> None:
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.core.plotting import save_figure
        from quadjax.evaluation.figures import trajectory_figure

    one = "evaluate.laps=1"  # all that a course has
    track = load_config(PRESET, [f"track.file={name}", one]).track
    print(describe_track(track))
    if figure is not None:
        save_figure(trajectory_figure([], track.gates, track.name), figure)
        wrote(figure)


def _write_vehicle(path: Path, data: Sequence[str]) -> None:
    with loading():
        from quadjax.core.files import write_text
        from quadjax.core.sections import build
        from quadjax.core.yaml_files import parse_overrides
        from quadjax.vehicle.airframe import Airframe
        from quadjax.vehicle.vehicle_file import vehicle_text

    airframe = build(Airframe, parse_overrides(data), "data")
    motor = {name: float(f"{value:.6g}") for name, value in airframe.motor_constants().items()}
    head = {"name": path.stem, "mass": airframe.mass, "width": round(airframe.width, 4)}
    comment = f"From {' '.join(data)}\n{COMMENT}"
    write_text(path, vehicle_text(head, {"motor": motor}, comment))


def _write_track(path: Path, settings: Sequence[str]) -> None:
    with loading():
        from quadjax.config.tracks import generated
        from quadjax.core.files import write_text
        from quadjax.core.yaml_files import Sources, parse_overrides, to_yaml

    tree = {"track": {"generate": parse_overrides(settings)}}
    tree = generated(tree, Sources("settings", {}))
    gates = {"name": path.stem, "rules": tree["rules"], "gates": tree["track"]["gates"]}
    head = "# World NED: meters, z down; yaw in degrees; size: width and height in meters."
    write_text(path, f"# Random track: {' '.join(settings)}\n{head}\n{to_yaml(gates)}")


def describe_track(track: "Track") -> str:
    """The gates of a track as a table, with its length."""
    import numpy as np

    places = np.array([gate.position for gate in track.gates])
    before = np.roll(places, 1, axis=0)
    if not track.closed and track.start is not None:
        before[0] = track.start.position
    legs = places - before
    length, flat = np.linalg.norm(legs, axis=1), np.linalg.norm(legs[:, :2], axis=1)
    heading = np.degrees(np.arctan2(legs[:, 1], legs[:, 0]))
    turn = np.mod(np.roll(heading, -1) - heading + 180.0, 360.0) - 180.0
    kind = "a lap" if track.closed else "a course"
    lines = [
        f"{track.name}: {len(places)} gates, {kind} of {length.sum():.1f} m between centers",
        f"{'gate':>4} {'north':>7} {'east':>7} {'height':>7} {'yaw':>7} {'leg':>7} {'slope':>7} "
        f"{'turn':>7}  opening",
        f"{'':>4} {'m':>7} {'m':>7} {'m':>7} {'deg':>7} {'m':>7} {'deg':>7} {'deg':>7}  m",
    ]
    for index, gate in enumerate(track.gates):
        x, y, z = gate.position
        slope = np.degrees(np.arctan2(-legs[index, 2], flat[index]))
        apart = flat[index] > 0.01 and np.roll(flat, -1)[index] > 0.01
        end = f"{round(turn[index]):>7}" if apart else f"{'-':>7}"  # of a leg straight up or down
        lines.append(
            f"{index + 1:>4} {x:>7.2f} {y:>7.2f} {-z:>7.2f} {round(gate.yaw_deg):>7} "
            f"{length[index]:>7.2f} {round(slope):>7} {end}  {_opening(gate)}"
        )
    return "\n".join(lines)


def _opening(gate: "Gate") -> str:
    """Size, shape and tilt of a gate."""
    width, height = gate.size
    size = f"{width:g} x {height:g}" if gate.shape == "rectangle" else f"{width:g} {gate.shape}"
    tilts = {"pitch": gate.pitch_deg, "roll": gate.roll_deg}
    return ", ".join([size, *(f"{name} {value:g} deg" for name, value in tilts.items() if value)])
