"""Loading a training config: the merge of its layers, its sections, and one check."""

import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from quadjax.config.checks import check
from quadjax.config.layers import LEARNERS, config_layers, drop_replaced, override_layers
from quadjax.config.scales import WithUnit, in_plain_units
from quadjax.config.schema import Config, Rules, Vehicle
from quadjax.core.errors import InputError, close_match, prefixed, short
from quadjax.core.imports import load_object
from quadjax.core.resources import find_config
from quadjax.core.section_keys import fields_at
from quadjax.core.sections import BadValue, Code, one_line_errors, refuse, validate
from quadjax.core.yaml_files import Tree, merge_trees
from quadjax.core.yaml_layers import Sources, merge_layers
from quadjax.learners.learner import Learner
from quadjax.race.random_track import RandomTrack, generate
from quadjax.race.track import TrackSection
from quadjax.vehicle.registry import base_model
from quadjax.vehicle.vehicle_file import for_each_rotor

SEPARATOR = re.compile(r" +(?=\+|[\w.]+=)")  # between a preset, its parts and overrides
CODE = [  # sections and keys whose values may be module:OBJECT
    (section, key)
    for section in Config.model_fields
    for key, field in fields_at(Config, [section]).items()
    if any(isinstance(item, Code) for item in field.metadata)
]


def load_config(
    config: Path | str,
    overrides: Sequence[str] = (),
    *,
    code: Collection[str] | None = None,
    units_written: WithUnit | None = None,
) -> Config:
    """A training config, complete and checked.

    Args:
        config: the name of a preset, or a YAML file. A key ``base`` names one or several other
            configs, over which this one is merged. A preset may be followed by parts and overrides,
            separated by spaces: ``"e2e +fastest seed=1"``; the path of a file is taken as a whole.
        overrides: ``key=value`` with dotted keys; the value is read as YAML. ``track=figure8`` is
            short for ``track.file=figure8.yaml``; likewise ``vehicle``. ``+PART`` merges
            ``PRESET_PART.yaml`` or, where there is none, ``PART.yaml`` over the config: of a folder
            ``parts`` next to the config, of ``./parts`` or of ``configs/parts``. It may also be a
            path. Overrides with ``=`` are merged over all parts.
        code: names ``module:OBJECT`` that may be imported; None: all. Empty for a file that the
            user did not name as a config, such as the ``config.yaml`` of a folder.
        units_written: filled with the numbers that are in units of the race in the files.

    Raises:
        InputError: one line that names the file, the key, the value and what is allowed.
    """
    name, *more = [str(config)] if os.path.exists(config) else SEPARATOR.split(str(config))
    if isinstance(overrides, str | dict):
        allowed = "a list of texts, such as ['track=figure8']"
        raise InputError(f"overrides: {short(overrides)}, allowed: {allowed}")
    overrides = [*more, *overrides]
    path = find_config(name)
    parts = [override[1:] for override in overrides if override.startswith("+")]
    changes = [override for override in overrides if not override.startswith("+")]
    layers = config_layers(path, parts, changes)
    for source, layer in layers if code is not None else ():
        _refuse_code(layer, str(source), code or ())
    tree, sources = merge_layers(layers, path, drop_replaced)
    for key, file in list(sources.files.items()):
        if key.startswith("vehicle.models."):  # where constants are until the model is known
            sources.files.setdefault(f"vehicle.constants.{key.rpartition('.')[2]}", file)
    tree = _with_opening(generate_track(tree, sources), sources)
    return parse_config(tree, sources, units_written)


load = load_config  # its name in the public interface


def with_track(config: Config, file: str) -> Config:
    """A config on the track of a file, with the file's rules: the override ``track=FILE``.

    A course is flown once, as it has one lap.

    Raises:
        InputError: a file that cannot be read, or a track that does not fit the config.
    """
    whole = config.model_dump(mode="json", by_alias=True)
    layers = [("config", whole), *override_layers([f"track.file={file}"], Path())]
    tree, sources = merge_layers(layers, "config", drop_replaced)
    if tree["track"].get("closed") is False:
        tree["evaluate"] |= {"laps": 1, "gates": None}
    return parse_config(_with_opening(generate_track(tree, sources), sources), sources)


def generate_track(tree: Tree, sources: Sources) -> Tree:
    """A tree with the gates of the random track that it asks for, and its rules below those of it.

    Raises:
        InputError: settings that are not allowed, or for which no track was found.
    """
    track = tree.get("track")
    if not isinstance(track, dict) or track.get("generate") is None:
        return tree
    path = sources.of("track.generate")
    for key in ("gates", "start", "closed"):
        if key in track:
            raise InputError(f"{path}: track.{key} has no effect with track.generate")
    settings = validate(RandomTrack, track["generate"], sources, "track.generate.")
    with prefixed(f"{path}: track.generate"):
        values = generate(settings)
    name = track.get("name") or f"random_{settings.gates}_{settings.seed}"
    track = {**track, "generate": None, "name": name, "gates": values["gates"]}
    rules = tree.get("rules", {})
    if isinstance(rules, dict):
        rules = merge_trees(values["rules"], rules)
    return {**tree, "track": track, "rules": rules}


def _with_opening(tree: Tree, sources: Sources) -> Tree:
    """A tree whose gates have the size ``track.opening``, if there is one.

    Frames around gates of one size keep their outer edges.
    """
    section, rules = tree.get("track"), tree.get("rules", {})
    if not isinstance(section, dict) or section.get("opening") is None:
        return tree
    track = validate(TrackSection, section, sources, "track.")
    opening, frame = track.opening or 0.0, validate(Rules, rules, sources, "rules.").gate_frame
    gates = [{**gate, "size": [opening, opening]} for gate in section["gates"]]
    if frame is not None:
        sizes = sorted({side for gate in track.gates for side in gate.size})
        outer = sizes[0] + 2.0 * frame
        allowed = f"at most {outer:g}, the outer edge of the frames"
        if len(sizes) > 1:
            allowed = f"null with rules.gate_frame {frame:g} around gates of sizes {sizes}"
        if len(sizes) > 1 or opening > outer:
            with one_line_errors(sources):
                refuse("track.opening", opening, allowed)
        rules = {**rules, "gate_frame": frame + 0.5 * (sizes[0] - opening)}
    return {**tree, "track": {**section, "gates": gates, "opening": None}, "rules": rules}


def parse_config(
    tree: Tree, source: str | Sources, units_written: WithUnit | None = None
) -> Config:
    """The config of a complete tree, such as the one in a policy file.

    Args:
        tree: plain values, as in a file. Keys that have a default may be missing.
        source: the file of the tree, or of each value, for messages.
        units_written: filled with the numbers that are in units of the race in the tree.

    Raises:
        InputError: a key or a value that is not allowed.
    """
    units_written = {} if units_written is None else units_written
    with one_line_errors(source):
        schema = _learner_schema(tree.get("learner", {}))
        vehicle = validate(Vehicle, tree.get("vehicle", {}), source, prefix="vehicle.")
        tree = {**tree, "vehicle": _with_constants(vehicle)}
        tree = in_plain_units(tree, schema, units_written)
        schedules = {} if tree.get("schedules") is None else tree["schedules"]
        if isinstance(schedules, dict):  # null removes a schedule; schedules=null removes all
            schedules = {key: value for key, value in schedules.items() if value is not None}
        learner = validate(schema, tree.get("learner", {}), source, prefix="learner.")
        tree = {**tree, "learner": learner, "schedules": schedules}
        config = validate(Config, tree, source)
        check(config)
    return config


def stored_config(tree: Tree, file: str, code: Collection[str] = ()) -> Config:
    """The config in a policy file, which may not name code.

    Args:
        tree: the config in the file.
        file: the policy file, for messages.
        code: names ``module:OBJECT`` that it may have, because the user has named them elsewhere.

    Raises:
        InputError: a key or a value that is not allowed, or that names other code.
    """
    source = f"{file}: config"
    _refuse_code(tree, source, code)
    return parse_config(tree, source)


def _refuse_code(tree: Mapping[str, Any], source: str, allowed: Collection[str] = ()) -> None:
    """Reject the tree of a config that names code that the user has not named elsewhere.

    Code is imported from the command line and from a config that the user names, never from a
    file that the program finds: in a policy file, in the folder of a run or of an export.
    """
    for key, name in _named_code(tree):
        if name not in allowed:
            raise InputError(
                f"{source}: {key} is {name!r:.80}; code that this file names is not imported, name "
                "the config of its race (CONFIG or --race CONFIG)"
            )


def _named_code(tree: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Keys and values of a config's tree that are ``module:object``."""
    for section, key in CODE:
        values = tree.get(section)
        value = values.get(key) if isinstance(values, dict) else None
        names = [value] if isinstance(value, str) else value or ()
        for name in names if isinstance(names, (list, tuple, dict)) else ():
            if isinstance(name, str) and ":" in name:
                yield f"{section}.{key}", name


def names_of_code(config: Config) -> list[str]:
    """The objects ``module:OBJECT`` of the user's own modules that a config names."""
    return [name for _, name in _named_code(config.model_dump(by_alias=True))]


def _with_constants(vehicle: Vehicle) -> Vehicle:
    """The vehicle with the constants of its model, complete."""
    name, models, model = vehicle.model, vehicle.models, base_model(vehicle.model)
    names = model.constant_names
    # A vehicle file names an own model by its name, not by its module.
    constants: Tree = {}
    for values in (models.get(model.name, {}), models.get(name, {}), vehicle.constants):
        constants |= for_each_rotor(values, names)
    for key in (f"vehicle.constants.{key}" for key in constants if key not in names):
        hint, listed = close_match(key.rpartition(".")[2], names), ", ".join(names)
        allowed = f"allowed with vehicle.model={name}: {listed}"
        raise BadValue(key, f"unknown key {key}{hint}; {allowed}")
    for key in (key for key in names if key not in constants):
        others = f"{vehicle.name} has constants of: {', '.join(models) or 'no model'}"
        others += "" if constants else f"; allowed: one of these models, or a section {model.name}"
        raise BadValue("vehicle.name", f"vehicle.constants.{key} is missing; {others}")
    return vehicle.replace(
        constants={key: constants[key] for key in names},
        models={key: x for key, x in models.items() if key not in (name, model.name)},
    )


def _learner_schema(learner: Any) -> type[Learner]:
    """The class of the learner section, which its algorithm names."""
    if not isinstance(learner, dict):
        refuse("learner", learner, "a mapping")
    name = learner.get("algorithm", "ppo")
    if isinstance(name, str) and ":" in name:
        schema = load_object(name, "learner.algorithm")
        if not (isinstance(schema, type) and issubclass(schema, Learner)):
            refuse("learner.algorithm", name, "a Learner")
        return schema
    if not isinstance(name, str) or name not in LEARNERS:
        refuse("learner.algorithm", name, f"{', '.join(LEARNERS)} or module:Class")
    return LEARNERS[name]
