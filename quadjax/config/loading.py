"""Loading a training config: presets, files, overrides, vehicle and track files."""

from collections.abc import Collection, Sequence
from pathlib import Path

from quadjax.config.checks import check, vehicle_model
from quadjax.config.code import refuse_code
from quadjax.config.renamed import check_renamed, without_retired
from quadjax.config.scales import in_plain_units
from quadjax.config.schema import Config, Rules, Schedule, Track
from quadjax.core.errors import InputError, prefixed, reading
from quadjax.core.imports import load_object
from quadjax.core.layers import Layer, from_layers, layer_of
from quadjax.core.resources import CONFIGS, find_config
from quadjax.core.sections import build
from quadjax.core.yaml_files import (
    Tree,
    close_match,
    find_file,
    flatten,
    merge_trees,
    parse_overrides,
    read_tree_with_bases,
    short,
)
from quadjax.learners.ppo.hyperparameters import PPO
from quadjax.learners.section import LearnerSection
from quadjax.learners.shac.hyperparameters import SHAC
from quadjax.race.random_track import RandomTrack, generate
from quadjax.vehicle.registry import MODELS
from quadjax.vehicle.vehicle_file import for_each_rotor, vehicle_values

LEARNERS: dict[str, type[LearnerSection]] = {"ppo": PPO, "shac": SHAC}
FROM_FILE = {
    "vehicle": ("file", "name", "width", "constants", "models"),
    "track": ("file", "generate", "name", "gates", "start", "closed"),
}
DATA_FILES = (  # keys that name .npz files
    ("vehicle", "residual"),
    ("run", "initial_policy"),
    ("run", "start_states"),
)
OTHER_TRACKS = "other_tracks"  # keys of a file that apply on tracks of another name than this one
PAPER_TRACK = "square4"
DEFAULTS: Tree = {"vehicle": {"file": "bebop1.yaml"}, "track": {"file": "square4.yaml"}}


def load_config(
    config: Path | str, overrides: Sequence[str] = (), *, code: Collection[str] | None = None
) -> Config:
    """A training config, complete and checked.

    Args:
        config: the name of a preset, or a YAML file. A key ``base`` names one or several other
            configs, over which this one is merged. Keys in its section ``other_tracks`` apply
            on tracks that are not named ``square4``; ``Config.notes`` lists them.
        overrides: ``key=value`` with dotted keys; the value is read as YAML. ``track=figure8`` is
            short for ``track.file=figure8.yaml``; likewise ``vehicle``.
        code: names ``module:OBJECT`` that may be imported; None: all. Empty for a file that the
            user did not name as a config, such as the ``config.yaml`` of a folder.

    Raises:
        InputError: one line that names the file, the key, the value and what is allowed.
    """
    path = find_config(config)
    tree, layers = _read(path, overrides, elsewhere=False)
    track, notes = tree.get("track"), []
    name = track.get("name") if isinstance(track, dict) else None
    if name != PAPER_TRACK:
        paper, (tree, layers) = tree, _read(path, overrides, elsewhere=True)
        if changes := _changes(paper, tree):
            notes = [f"track {short(name or 'without a name')}: {OTHER_TRACKS} sets {changes}"]
    if code is not None:
        refuse_code(tree, str(path), code)
    with from_layers(layers, str(path)):
        return config_of(tree, str(path)).with_notes(notes)


def _changes(before: Tree, after: Tree) -> str:
    """The values of a tree that differ from those of another one, as text."""
    old, new = (flatten(tree, leaf=("linear",)) for tree in (before, after))
    changed = {key: value for key, value in new.items() if key not in old or old[key] != value}
    return ", ".join(f"{key} to {short(value)}" for key, value in changed.items())


def _read(path: Path, overrides: Sequence[str], elsewhere: bool) -> tuple[Tree, list[Layer]]:
    """The merged tree of a file, its bases and overrides, and where its values come from.

    Args:
        path: of the file.
        overrides: ``key=value``.
        elsewhere: merge the section ``other_tracks`` of each file over the rest of that file.
    """
    layers: list[Layer] = []

    def merge(under: Tree, over: Tree, file: Path) -> Tree:
        own = {key: value for key, value in over.items() if key != OTHER_TRACKS}
        own = _with_data_paths(own, file.parent)
        under = _merge(under, own, file.parent, str(file), layers)
        other = over.get(OTHER_TRACKS, {})
        if not isinstance(other, dict) or "track" in other:
            given = f"{OTHER_TRACKS} is {short(other)}"
            raise InputError(f"{file}: {given}, allowed: a mapping of keys other than track")
        return _merge(under, other, file.parent, str(file), layers) if elsewhere else under

    tree = read_tree_with_bases(path, merge)
    if not tree:
        raise InputError(f"{path}: empty; write at least the preset to start from, as base: e2e")
    tree = merge_trees(_defaults(tree), tree)
    over = parse_overrides([_expand(override) for override in overrides])
    here = Path() if _exists(over, Path()) else path.parent
    tree = _merge(tree, over, here, "overrides", layers)
    with from_layers(layers, str(path)):
        return with_opening(generated(tree, str(path)), str(path)), layers


def generated(tree: Tree, source: str) -> Tree:
    """A tree with the gates and the rules of the random track that it asks for, if it does.

    Rules of the tree have precedence.

    Raises:
        InputError: settings that are not allowed, or for which no track was found.
    """
    track = tree.get("track")
    if not isinstance(track, dict) or track.get("generate") is None:
        return tree
    for key in ("gates", "start", "closed"):
        if key in track:
            raise InputError(f"{source}: track.{key} has no effect with track.generate")
    if not isinstance(track["generate"], dict):
        allowed = f"a mapping of {', '.join(RandomTrack.model_fields)}"
        given = short(track["generate"])
        raise InputError(f"{source}: track.generate is {given}, allowed: {allowed}")
    own = build(RandomTrack, track["generate"], source, "track.generate.")
    with prefixed(source):
        values = generate(own)
    name = track.get("name") or f"random_{own.gates}_{own.seed}"
    track = {**track, "generate": None, "name": name, "gates": values["gates"]}
    rules = merge_trees(values["rules"], tree.get("rules") or {})
    return {**tree, "track": track, "rules": rules}


def with_opening(tree: Tree, source: str) -> Tree:
    """A tree whose gates have the size ``track.opening``, if there is one.

    Frames around gates of one size keep their outer edges.

    Raises:
        InputError: a value that is not allowed, or frames around gates of several sizes.
    """
    track = tree.get("track")
    if not isinstance(track, dict) or track.get("opening") is None:
        return tree
    own = build(Track, track, source, "track.")
    assert own.opening is not None
    gates = [{**gate, "size": [own.opening, own.opening]} for gate in track["gates"]]
    tree = {**tree, "track": {**track, "gates": gates, "opening": None}}
    rules = tree.get("rules") or {}
    frame = build(Rules, rules, source, "rules.").gate_frame
    if frame == 0.0:
        return tree
    sizes = {side for gate in own.gates for side in gate.size}
    wider = frame + 0.5 * (min(sizes) - own.opening)
    if len(sizes) > 1 or wider < 0.0:
        allowed = f"null with rules.gate_frame {frame:g} around gates of sizes {sorted(sizes)}"
        raise InputError(f"{source}: track.opening is {own.opening:g}, allowed: {allowed}")
    return {**tree, "rules": {**rules, "gate_frame": wider}}


def _with_data_paths(tree: Tree, folder: Path) -> Tree:
    """The config of a file in ``folder``, with the paths of the data files next to it."""
    for section, key in DATA_FILES:
        own = tree.get(section)
        if not isinstance(own, dict):
            continue
        name = own.get(key)
        if isinstance(name, str) and (folder / name).is_file():
            tree = {**tree, section: {**own, key: str(folder / name)}}
    return tree


def vehicle_configs(file: Path | str, model: str | None = None) -> list[Config]:
    """A checked config for each model whose constants are in a vehicle file.

    Args:
        file: next to the current folder, or in ``configs/vehicles``.
        model: only this one: ``motor``, ``rate`` or ``module:OBJECT``.

    Raises:
        InputError: an unreadable file, no known model in it, or invalid constants.
    """
    known = list(_file_values("vehicle", find_file(str(file), Path(), "vehicles"))["models"])
    names = [model] if model else [name for name in known if name in MODELS]
    if not names:
        raise InputError(f"{file}: has {', '.join(known) or 'no model'}; name its VehicleModel")
    configs = []
    for name in names:
        own = {"file": str(file), "model": name, "width": 0.0}  # no check of the gates
        tree = _merge(_defaults({}), {"vehicle": own}, Path(), str(file))
        configs.append(config_of(tree, str(file)))
    return configs


def _defaults(tree: Tree) -> Tree:
    """The default vehicle and track, unless a config names a file or gives all gates."""
    absent = {
        section: value
        for section, value in DEFAULTS.items()
        if not (
            isinstance(tree.get(section), dict)
            and {"models", "gates", "generate"} & set(tree[section])
        )
    }
    return _merge({}, absent, CONFIGS, "defaults")


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


def _merge(
    under: Tree, over: Tree, folder: Path, source: str, layers: list[Layer] | None = None
) -> Tree:
    """The config ``over`` on ``under``, with the vehicle and track files that ``over`` names.

    ``layers`` gets these files and ``over``.

    A file replaces the name, constants or gates of lower configs; another algorithm replaces the
    hyperparameters of the lower config.
    """
    check_renamed(over, source)
    over, under = _nested_schedules(over), dict(under)
    own_layer = Layer(source, over)
    for section, keys in FROM_FILE.items():
        own = over.get(section)
        own = {"file": own} if isinstance(own, str) else own
        if not isinstance(own, dict) or own.get("file") is None:
            continue
        if not isinstance(own["file"], str):
            raise InputError(f"{section}.file is {short(own['file'])}, allowed: name of a file")
        with prefixed(f"{source}: {section}.file"):
            path = find_file(own["file"], folder, f"{section}s")
        values = _file_values(section, path)
        if layers is not None:
            layers.append(Layer(str(path), layer_of(section, values)))
        if "rules" in values:  # of a track: those of its hall
            own_rules = over.get("rules")
            rules = values.pop("rules")
            over = {**over, "rules": merge_trees(rules, own_rules) if own_rules else rules}
        lower = under.get(section, {})
        if section == "vehicle" and "model" not in own:
            _check_level(lower, values, own["file"])
        under[section] = {k: v for k, v in lower.items() if k not in keys}
        over = {**over, section: merge_trees(values, {**own, "file": None})}
    if layers is not None:
        layers.append(own_layer)
    _switch_model(under, over)
    _switch_gates(under, over)
    learner = over.get("learner")
    if isinstance(learner, dict) and "algorithm" in learner:
        lower = under.get("learner", {})
        if isinstance(lower, dict) and lower.get("algorithm") != learner["algorithm"]:
            under["learner"] = {}
            schedules = under.get("schedules") or {}
            under["schedules"] = {k: v for k, v in schedules.items() if "learner." not in k}
    return merge_trees(under, over)


def _check_level(under: Tree, values: Tree, file: str) -> None:
    """Refuse a vehicle file that would turn a race of body rates into one of rotor commands."""
    model = values.get("model")
    if under.get("model") == "rate" and model not in (None, "rate"):
        raise InputError(
            f"vehicle.file {file} has the model {model}, the config the model rate; allowed: a "
            f"file with constants of rate, or vehicle.model={model} for rotor commands"
        )


def _switch_model(under: Tree, over: Tree) -> None:
    """Keep the constants below with the other models, where ``over`` has another one."""
    lower, own = under.get("vehicle"), over.get("vehicle")
    if not (isinstance(lower, dict) and isinstance(own, dict) and "model" in own):
        return
    model, constants = lower.get("model", "motor"), lower.get("constants")
    if own["model"] != model and isinstance(constants, dict):
        lower = {key: value for key, value in lower.items() if key != "constants"}
        under["vehicle"] = merge_trees(lower, {"models": {model: constants}})


def _switch_gates(under: Tree, over: Tree) -> None:
    """Drop the gates below where ``over`` asks for a random track, and the other way around."""
    lower, own = under.get("track"), over.get("track")
    if not (isinstance(lower, dict) and isinstance(own, dict)):
        return
    replaced: tuple[str, ...] = ()
    if own.get("generate") is not None:
        replaced = tuple(key for key in FROM_FILE["track"] if key != "generate")
    elif "gates" in own:
        replaced = ("generate",) if "name" in own else ("generate", "name")
    under["track"] = {key: value for key, value in lower.items() if key not in replaced}


def _file_values(section: str, path: Path) -> Tree:
    """The keys that a track or vehicle file sets in its section."""
    tree = read_tree_with_bases(path)
    if section == "track":
        for key in tree:
            allowed = sorted((*FROM_FILE["track"][1:], "rules"))
            if key not in allowed:
                hint = close_match(key, allowed)
                raise InputError(f"{path}: unknown key {key}{hint}; allowed: {', '.join(allowed)}")
        return {"name": path.stem, **({} if "generate" in tree else {"gates": []}), **tree}
    return vehicle_values(path, tree)


def _nested_schedules(tree: Tree) -> Tree:
    """The tree with flat keys of schedules: ``learner.std``, not ``learner: {std: ..}``."""
    flat: Tree = {}

    def collect(node: object, prefix: str) -> None:
        fields = {field.alias or name for name, field in Schedule.model_fields.items()}
        if not isinstance(node, dict) or not node or fields & set(node):
            flat[prefix] = node
            return
        for key, value in node.items():
            collect(value, f"{prefix}.{key}" if prefix else key)

    if not isinstance(tree.get("schedules"), dict):
        return tree
    collect(tree["schedules"], "")
    flat.pop("", None)
    return {**tree, "schedules": flat}


def config_of(tree: Tree, source: str) -> Config:
    """The config of a complete tree, such as the one in a policy file.

    Args:
        tree: as ``Config.model_dump`` gives it.
        source: for messages.

    Raises:
        InputError: a key or a value that is not allowed.
    """
    tree = without_retired(tree)
    vehicle = tree.get("vehicle")
    if not isinstance(vehicle, dict):
        raise InputError(f"{source}: vehicle is {short(vehicle)}, allowed: a mapping")
    learner = tree.get("learner", {})
    if not isinstance(learner, dict):
        raise InputError(f"{source}: learner is {short(learner)}, allowed: a mapping")
    schema = _learner_schema(learner, source)
    with prefixed(source):
        vehicle = _with_constants(vehicle, source)
        tree, written = in_plain_units({**tree, "vehicle": vehicle}, schema)
    schedules = {} if tree.get("schedules") is None else tree["schedules"]
    if isinstance(schedules, dict):  # null removes a schedule; schedules=null removes all
        schedules = {key: value for key, value in schedules.items() if value is not None}
    tree = {
        **tree,
        "learner": build(schema, tree.get("learner", {}), source, prefix="learner."),
        "schedules": schedules,
    }
    config = build(Config, tree, source)
    with prefixed(source):
        check(config)
    return config.with_race_units(written)


def _with_constants(vehicle: Tree, source: str) -> Tree:
    """The vehicle section with the constants of its model, complete."""
    vehicle = dict(vehicle)
    models = vehicle.get("models", {})
    if not isinstance(models, dict):
        raise InputError(f"{source}: vehicle.models is {short(models)}, allowed: a mapping")
    for key, values in models.items():
        if not isinstance(values, dict):
            given = f"vehicle.models.{key} is {short(values)}"
            raise InputError(f"{source}: {given}, allowed: a mapping of constants")
    name, own = vehicle.get("model", "motor"), vehicle.get("constants", {})
    if not isinstance(name, str):
        raise InputError(f"{source}: vehicle.model is {short(name)}, allowed: text")
    if not isinstance(own, dict):
        raise InputError(f"{source}: vehicle.constants is {short(own)}, allowed: a mapping")
    model = vehicle_model(name)
    names = model.constant_names
    # A vehicle file names an own model by its name, not by its module.
    constants: Tree = {}
    for values in (models.get(model.name, {}), models.get(name, {}), own):
        constants |= for_each_rotor(values, names)
    for key in constants:
        if key not in names:
            raise InputError(
                f"{source}: unknown key vehicle.constants.{key}{close_match(key, names)}; allowed "
                f"with vehicle.model={name}: {', '.join(names)}"
            )
    for key in names:
        if constants.get(key) is None:
            where = f"; {vehicle.get('name')} has constants of: {', '.join(models) or 'no model'}"
            raise InputError(f"{source}: vehicle.constants.{key} is missing{where}")
    return {
        **vehicle,
        "constants": {key: constants[key] for key in names},
        "models": {k: values for k, values in models.items() if k not in (name, model.name)},
    }


def _learner_schema(tree: Tree, source: str) -> type[LearnerSection]:
    """The class of the learner section, which its algorithm names."""
    name = tree.get("algorithm", "ppo")
    allowed = f"{', '.join(LEARNERS)} or module:Class"
    if isinstance(name, str) and ":" in name:
        schema = load_object(name, "learner.algorithm")
        if not (isinstance(schema, type) and issubclass(schema, LearnerSection)):
            raise InputError(f"{source}: learner.algorithm is {name}: not a LearnerSection")
        return schema
    if not isinstance(name, str) or name not in LEARNERS:
        raise InputError(f"{source}: learner.algorithm is {short(name)}, allowed: {allowed}")
    return LEARNERS[name]
