"""The layers of a training config, and the values that a higher layer removes.

A layer is a source, a file or the overrides, and the values that it sets. In the order of their
merge they are: the default drone and track, the bases of the config, the config, its parts, the
name of the run with its parts, and the overrides. Below a layer that names a vehicle or track file
is a layer of this file's values. Keys that no layer sets have the defaults of the schema.
"""

from collections.abc import Sequence
from pathlib import Path

from quadjax.core.errors import InputError, close_match, prefixed, short
from quadjax.core.imports import load_object
from quadjax.core.resources import CONFIGS, find_file, preset_names
from quadjax.core.yaml_files import Tree, Whole, flatten, merge_trees, parse_overrides
from quadjax.core.yaml_layers import Layer, read_layers, read_tree_with_bases
from quadjax.learners.learner import Learner
from quadjax.learners.ppo import PPO
from quadjax.learners.schedules import Schedule
from quadjax.learners.shac import SHAC
from quadjax.vehicle.vehicle_file import vehicle_values

OVERRIDES = "overrides"  # the source of the last layer
DEFAULTS = {"vehicle": "bebop1.yaml", "track": "square4.yaml"}
VEHICLE: Tree = {"file": None, "width": 0.0, "fitted_speed": None, "constants": Whole()}
TRACK: Tree = {"file": None, "generate": None, "gates": [], "start": None, "closed": True}
LEARNERS: dict[str, type[Learner]] = {"ppo": PPO, "shac": SHAC}
DATA_FILES = (("vehicle", "residual"), ("run", "initial_policy"))  # .npz
SCHEDULE_KEYS = [field.alias or name for name, field in Schedule.model_fields.items()]


def config_layers(path: Path, parts: Sequence[str], overrides: Sequence[str]) -> list[Layer]:
    """The layers of a config, its parts (names or paths) and its overrides, the lowest first.

    Raises:
        InputError: a file that cannot be read, or an override that is not ``key=value``.
    """
    files = read_layers(path)
    if not any(tree for _, tree in files):
        raise InputError(f"{path}: empty; write at least the preset to start from, as base: e2e")
    presets = [Path(file).stem for file, _ in reversed(files)]
    names = [str(tree["name"]) for _, tree in files if "name" in tree] or ["run"]
    for part in parts:
        files += read_layers(_find_part(part, path, presets))
    if parts:  # the name of the run: e2e_residual
        stems = [part.rpartition("/")[2].removesuffix(".yaml") for part in parts]
        files.append((path, {"name": "_".join([names[-1], *stems])}))
    layers = [x for file, tree in files for x in _with_files(file, tree, [Path(file).parent])]
    defaults: list[Layer] = []
    for section, name in DEFAULTS.items():  # but of a section whose values a file has itself
        keys = {key for _, tree in files for key in _section(tree, section)}
        if not keys & {"models", "gates", "generate"}:
            defaults += _with_files("defaults", {section: {"file": name}}, [CONFIGS])
    return [*defaults, *layers, *override_layers(overrides, path.parent)]


def override_layers(overrides: Sequence[str], folder: Path) -> list[Layer]:
    """The layers of overrides, the lowest first; files are also found in ``folder``."""
    over = parse_overrides([_expand(override) for override in overrides])
    keys = [override.partition("=")[0] for override in overrides]
    return _with_files(OVERRIDES, over, [Path(), folder], keys)


def _find_part(name: str, config: Path, presets: Sequence[str]) -> Path:
    """The file of a part: a path, or ``PRESET_NAME.yaml`` or ``NAME.yaml`` in a folder ``parts``.

    The folder of the config is searched before the current one and that of quadjax; ``presets`` are
    the names of the config and of its bases, the last one first.
    """
    if name.endswith(".yaml") or "/" in name:
        return find_file(name, [Path()], "parts")
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


def _with_files(
    source: Path | str, tree: Tree, folders: Sequence[Path], keys: Sequence[str] = ()
) -> list[Layer]:
    """The layer of a file, above those of the vehicle and track files that it names.

    In the layer, the names of ``.npz`` files next to a file are paths, and nested schedules have
    dotted keys. A schedule that an override gives as a mapping replaces the lower one as a whole.
    ``folders`` are those of the files that it names; ``keys`` those of overrides.
    """
    for section, key in DATA_FILES:
        name = _section(tree, section).get(key)
        if source != OVERRIDES and isinstance(name, str) and (folders[0] / name).is_file():
            tree = merge_trees(tree, {section: {key: str(folders[0] / name)}})
    if isinstance(tree.get("schedules"), dict):  # schedules: {learner: {std: ..}} is meant too
        tree = {**tree, "schedules": flatten(tree["schedules"], SCHEDULE_KEYS)}
        for key, value in tree["schedules"].items():
            hint = close_match(key.rpartition(".")[2], SCHEDULE_KEYS)
            if hint and value is not None and not isinstance(value, dict):
                allowed = ", ".join(SCHEDULE_KEYS)
                raise InputError(f"{source}: unknown key schedules.{key}{hint}; allowed: {allowed}")
            of_parts = any(x.startswith(f"schedules.{key}.") for x in keys)  # schedules.KEY.until=2
            whole = isinstance(value, dict) and "linear" in value
            if source == OVERRIDES and whole and not of_parts:
                tree["schedules"][key] = Whole(value)
    layers: list[Layer] = []
    for section in DEFAULTS:
        named = tree.get(section)
        values = {"file": named} if isinstance(named, str) else _section(tree, section)
        if section in tree and not isinstance(named, str | dict):
            allowed = f"a file, one of {', '.join(preset_names(f'{section}s'))}, or a mapping"
            raise InputError(f"{source}: {section} is {short(named)}, allowed: {allowed}")
        if (file := values.get("file")) is None:
            continue
        key = section if isinstance(named, str) or section in keys else f"{section}.file"
        if not isinstance(file, str):
            raise InputError(f"{source}: {key} is {short(file)}, allowed: name of a file")
        with prefixed(f"{source}: {key}"):
            path = find_file(file, folders, f"{section}s")
        of_file = file_values(section, path)
        if "model" in values:
            of_file[section].pop("model", None)
        if values.get("generate") is not None and "gates" in of_file[section]:
            raise InputError(f"{source}: track.gates has no effect with track.generate")
        layers.append((path, of_file))
        tree = {**tree, section: {**values, "file": None}}
    return [*layers, (source, tree)]


def file_values(section: str, path: Path) -> Tree:
    """What a vehicle or track file sets; keys that it leaves out have their defaults."""
    tree, rules = read_tree_with_bases(path, f"{section}s"), {}
    if section == "vehicle":
        values = VEHICLE | vehicle_values(path, tree)
    else:
        allowed = sorted({"name", "rules", *TRACK} - {"file"})
        for key in tree:
            if key not in allowed:
                hint = close_match(key, allowed)
                raise InputError(f"{path}: unknown key {key}{hint}; allowed: {', '.join(allowed)}")
        rules = {"rules": tree.pop("rules")} if "rules" in tree else {}  # of the track's hall
        values = ({} if "generate" in tree else TRACK) | {"name": path.stem} | tree
    values = {key: Whole(x) if isinstance(x, dict) else x for key, x in values.items()}
    return {section: values, **rules}


def drop_replaced(tree: Tree, over: Tree, source: str) -> Tree:
    """A tree without the values that a layer replaces as a whole.

    Constants of the earlier model move to ``vehicle.models``. Gates replace a random track, and a
    random track replaces gates, with their name, start and ``closed``. Another algorithm replaces
    the hyperparameters and their schedules, unless its class is derived from that of the former.

    Raises:
        InputError: a vehicle file that would turn a race of body rates into one of rotor commands.
    """
    tree, lower = dict(tree), _section(tree, "vehicle")
    model, new = lower.get("model", "motor"), _section(over, "vehicle").get("model")
    if new not in (None, model):
        if model == "rate" and isinstance(_section(over, "vehicle").get("models"), Whole):
            raise InputError(
                f"vehicle.file {source} has the model {new}, the config the model rate; "
                f"allowed: a file with constants of rate, or vehicle.model={new} for rotor commands"
            )
        if constants := lower.get("constants"):
            models = merge_trees(_section(lower, "models"), {str(model): constants})
            tree["vehicle"] = {**lower, "constants": {}, "models": models}
    lower, values = _section(tree, "track"), _section(over, "track")
    if values.get("generate") is not None:
        replaced = {"name", *TRACK} - {"generate"}
        tree["track"] = {key: x for key, x in lower.items() if key not in replaced}
    elif "gates" in values:
        replaced = {"generate"} if "name" in values else {"generate", "name"}
        tree["track"] = {key: x for key, x in lower.items() if key not in replaced}
    algorithm = _section(tree, "learner").get("algorithm", "ppo")
    new = _section(over, "learner").get("algorithm", algorithm)
    if new != algorithm and not _is_derived(new, algorithm):
        schedules = _section(tree, "schedules").items()
        tree["schedules"] = {key: x for key, x in schedules if "learner." not in key}
        tree["learner"] = {}
    return tree


def _is_derived(new: object, algorithm: object) -> bool:
    """Whether a learner of the user's own is derived from the one that it replaces."""
    if not (isinstance(new, str) and ":" in new):
        return False
    if ":" not in str(algorithm) and algorithm not in LEARNERS:
        return False
    former = LEARNERS.get(str(algorithm)) or load_object(str(algorithm), "learner.algorithm")
    return isinstance(kind := load_object(new, "learner.algorithm"), type) and (
        isinstance(former, type) and issubclass(kind, former)
    )


def _section(tree: Tree, section: str) -> Tree:
    """A section of a tree; empty where it has none, or another value in its place."""
    values = tree.get(section)
    return values if isinstance(values, dict) else {}


def _expand(override: str) -> str:
    """``track=figure8`` as ``track.file=figure8``; any other override as it is."""
    key, equals, value = override.partition("=")
    short_form = equals and key in DEFAULTS and isinstance(parse_overrides([override])[key], str)
    return f"{key}.file={value}" if short_form else override
