"""The layers of a training config, and their merge.

A layer is what one file sets. In the order of their merge they are: the default drone and track,
the bases of the config, the config, its parts, and the overrides. A layer that names a vehicle or
track file has the values of this file below it.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from quadjax.core.errors import InputError, prefixed, reading
from quadjax.core.resources import CONFIGS, preset_names
from quadjax.core.yaml_files import (
    Sources,
    Tree,
    close_match,
    files_of,
    find_file,
    flatten,
    merge_trees,
    parse_overrides,
    read_layers,
    read_tree_with_bases,
    short,
)
from quadjax.learners.section import Schedule
from quadjax.vehicle.vehicle_file import vehicle_values

FROM_FILE = {  # keys that a vehicle or track file sets, also where it leaves them out
    "vehicle": ("file", "name", "width", "constants", "models"),
    "track": ("file", "generate", "name", "gates", "start", "closed"),
}
DATA_FILES = (("vehicle", "residual"), ("run", "initial_policy"), ("run", "start_states"))  # .npz
DEFAULTS = {"vehicle": "bebop1.yaml", "track": "square4.yaml"}
SCHEDULE_KEYS = [field.alias or name for name, field in Schedule.model_fields.items()]


class Layer(NamedTuple):
    """What a file, or a command line, sets."""

    source: str
    tree: Tree
    replaces: str = ""  # the section whose keys ``FROM_FILE`` it replaces
    with_model: bool = False  # the layer above it sets the vehicle's model


def config_layers(path: Path, parts: Sequence[str], overrides: Sequence[str]) -> list[Layer]:
    """The layers of a config, the lowest first.

    Args:
        path: of its file.
        parts: names or paths; see ``find_part``.
        overrides: ``key=value``.

    Raises:
        InputError: a file that cannot be read, or an override that is not ``key=value``.
    """
    files = read_layers(path)
    if not any(tree for _, tree in files):
        raise InputError(f"{path}: empty; write at least the preset to start from, as base: e2e")
    files += _part_files(parts, path, files)
    layers = [x for file, tree in files for x in with_files(str(file), tree, file.parent)]
    over = parse_overrides([_expand(override) for override in overrides])
    here = Path() if _exists(over, Path()) else path.parent
    return [*default_layers(files), *layers, *with_files("overrides", over, here)]


def _part_files(
    parts: Sequence[str], path: Path, files: Sequence[tuple[Path, Tree]]
) -> list[tuple[Path, Tree]]:
    """The layers of parts, and one for the name of the run: ``e2e_residual``."""
    presets = [file.stem for file, _ in reversed(files)]
    names = [tree["name"] for _, tree in files if "name" in tree] or ["run"]
    layers: list[tuple[Path, Tree]] = []
    for part in parts:
        layers += read_layers(find_part(part, path, presets))
    stems = [part.rpartition("/")[2].removesuffix(".yaml") for part in parts]
    return [*layers, (path, {"name": "_".join([str(names[-1]), *stems])})] if parts else []


def find_part(name: str, config: Path, presets: Sequence[str]) -> Path:
    """The file of a part: a path, or ``PRESET_NAME.yaml`` or ``NAME.yaml`` in a folder ``parts``.

    Args:
        name: of the part.
        config: the file that it is merged over; its folder is searched before the current one and
            that of quadjax.
        presets: names of that file and of its bases, the last one first.

    Raises:
        InputError: no such part; with the names of those of quadjax.
    """
    if name.endswith(".yaml") or "/" in name:
        return find_file(name, Path(), "parts")
    folders = [config.parent / "parts", Path("parts"), CONFIGS / "parts"]
    for stem in (*(f"{preset}_{name}" for preset in presets), name):
        for folder in folders:
            if (folder / f"{stem}.yaml").is_file():
                return folder / f"{stem}.yaml"
    names = set(preset_names("parts"))
    for preset in presets:
        names = {part.removeprefix(f"{preset}_") for part in names}
    hint, listed = close_match(name, sorted(names)), ", ".join(sorted(names))
    raise InputError(f"+{name}: no such part{hint}; parts of quadjax: {listed}")


def default_layers(files: Sequence[tuple[Path, Tree]]) -> list[Layer]:
    """The default vehicle and track, unless a file has the constants or all gates itself."""
    layers: list[Layer] = []
    for section, file in DEFAULTS.items():
        trees = [tree.get(section) for _, tree in files]
        keys = {key for tree in trees if isinstance(tree, dict) for key in tree}
        if not {"models", "gates", "generate"} & keys:
            layers += with_files("defaults", {section: {"file": file}}, CONFIGS)
    return layers


def with_files(source: str, tree: Tree, folder: Path) -> list[Layer]:
    """The layer of a file, above those of the vehicle and track files that it names."""
    for section, key in DATA_FILES:
        values = tree.get(section)
        name = values.get(key) if isinstance(values, dict) else None
        if source != "overrides" and isinstance(name, str) and (folder / name).is_file():
            tree = merge_trees(tree, {section: {key: str(folder / name)}})
    if isinstance(tree.get("schedules"), dict):  # schedules: {learner: {std: ..}} is meant too
        tree = {**tree, "schedules": flatten(tree["schedules"], SCHEDULE_KEYS)}
    layers: list[Layer] = []
    for section in FROM_FILE:
        values = tree.get(section)
        values = {"file": values} if isinstance(values, str) else values
        if not isinstance(values, dict) or values.get("file") is None:
            continue
        if not isinstance(values["file"], str):
            raise InputError(f"{section}.file is {short(values['file'])}, allowed: name of a file")
        with prefixed(f"{source}: {section}.file"):
            path = find_file(values["file"], folder, f"{section}s")
        with_model = "model" in values
        config = file_values(section, path)
        if values.get("generate") is not None and "gates" in config[section]:
            raise InputError(f"{source}: track.gates has no effect with track.generate")
        layers.append(Layer(str(path), config, section, with_model))
        tree = {**tree, section: {**values, "file": None}}
    return [*layers, Layer(source, tree)]


def file_values(section: str, path: Path) -> Tree:
    """The config that a track or vehicle file stands for."""
    tree = read_tree_with_bases(path)
    if section == "vehicle":
        return {"vehicle": vehicle_values(path, tree)}
    allowed = sorted((*FROM_FILE["track"][1:], "rules"))
    for key in tree:
        if key not in allowed:
            hint = close_match(key, allowed)
            raise InputError(f"{path}: unknown key {key}{hint}; allowed: {', '.join(allowed)}")
    rules = {"rules": tree.pop("rules")} if "rules" in tree else {}  # of the track's hall
    gates: Tree = {} if "generate" in tree else {"gates": []}
    return {"track": {"name": path.stem, **gates, **tree}, **rules}


def merged(layers: Sequence[Layer], path: str) -> tuple[Tree, Sources]:
    """The tree of layers, and the file of each value.

    A vehicle or track file replaces the name, constants or gates below it; another algorithm
    replaces the hyperparameters below it.

    Raises:
        InputError: a vehicle file with a model of another level of control.
    """
    tree: Tree = {}
    files: dict[str, str] = {}
    for layer in layers:
        if layer.replaces == "vehicle" and not layer.with_model:
            _check_level(tree, layer)
        tree = merge_trees(_below(tree, layer), layer.tree)
        sources = files_of(layer.tree, layer.source)
        for key in list(sources):  # constants are in vehicle.models until the model is known
            if key.startswith("vehicle.models."):
                sources["vehicle.constants"] = layer.source
                sources[f"vehicle.constants.{key.rpartition('.')[2]}"] = layer.source
        files |= sources
    return tree, Sources(path, files)


def _below(tree: Tree, layer: Layer) -> Tree:
    """What stays of a tree below a layer."""
    tree, over = dict(tree), layer.tree
    if layer.replaces:
        keys = FROM_FILE[layer.replaces]
        values = tree.get(layer.replaces)
        if isinstance(values, dict):
            tree[layer.replaces] = {key: values[key] for key in values if key not in keys}
    _switch_model(tree, over)
    _switch_gates(tree, over)
    learner, lower = over.get("learner"), tree.get("learner", {})
    if isinstance(learner, dict) and "algorithm" in learner:
        if isinstance(lower, dict) and lower.get("algorithm") != learner["algorithm"]:
            tree["learner"] = {}
            schedules = tree.get("schedules") or {}
            tree["schedules"] = {k: v for k, v in schedules.items() if "learner." not in k}
    return tree


def _check_level(under: Tree, layer: Layer) -> None:
    """Refuse a vehicle file that would turn a race of body rates into one of rotor commands."""
    model = layer.tree["vehicle"].get("model")
    lower = under.get("vehicle")
    if isinstance(lower, dict) and lower.get("model") == "rate" and model not in (None, "rate"):
        raise InputError(
            f"vehicle.file {layer.source} has the model {model}, the config the model rate; "
            f"allowed: a file with constants of rate, or vehicle.model={model} for rotor commands"
        )


def _switch_model(under: Tree, over: Tree) -> None:
    """Keep the constants below with the other models, where ``over`` has another one."""
    lower, values = under.get("vehicle"), over.get("vehicle")
    if not (isinstance(lower, dict) and isinstance(values, dict) and "model" in values):
        return
    model, constants = lower.get("model", "motor"), lower.get("constants")
    if values["model"] != model and isinstance(constants, dict):
        lower = {key: value for key, value in lower.items() if key != "constants"}
        under["vehicle"] = merge_trees(lower, {"models": {model: constants}})


def _switch_gates(under: Tree, over: Tree) -> None:
    """Drop the gates below where ``over`` asks for a random track, and the other way around."""
    lower, values = under.get("track"), over.get("track")
    if not (isinstance(lower, dict) and isinstance(values, dict)):
        return
    replaced: tuple[str, ...] = ()
    if values.get("generate") is not None:
        replaced = tuple(key for key in FROM_FILE["track"] if key != "generate")
    elif "gates" in values:
        replaced = ("generate",) if "name" in values else ("generate", "name")
    under["track"] = {key: value for key, value in lower.items() if key not in replaced}


def _expand(override: str) -> str:
    """``track=figure8`` as ``track.file=figure8``; any other override as it is."""
    key, equals, value = override.partition("=")
    short_form = equals and key in FROM_FILE and isinstance(parse_overrides([override])[key], str)
    return f"{key}.file={value}" if short_form else override


def _exists(over: Tree, folder: Path) -> bool:
    """Whether a vehicle or track file of the overrides is in ``folder``."""
    sections = [over.get(name) for name in FROM_FILE]
    names = [s.get("file") if isinstance(s, dict) else s for s in sections]
    files = [name for name in names if isinstance(name, str)]
    with reading(", ".join(files)):
        return any((folder / name).is_file() for name in files)
