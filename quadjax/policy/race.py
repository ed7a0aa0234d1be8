"""The race of a policy file: the config that every command flies it in."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from quadjax.config.loading import load_config, names_of_code, stored_config, with_track
from quadjax.config.schema import Config
from quadjax.core.errors import InputError, short, warn
from quadjax.policy.file import Policy
from quadjax.vehicle.residual import read_residual

FLOWN = ("vehicle", "track", "rules", "battery")  # sections of a config that describe a flight
NOT_FLOWN = ("name", "file", "models", "width", "fitted_speed", "generate", "opening")
MAX_LISTED = 3  # differences in a warning


class Difference(NamedTuple):
    """A key, or the name of a vehicle or a track, of which two races have other values."""

    key: str
    there: str
    here: str

    def __str__(self) -> str:
        """The difference of a race from that of a training, as text."""
        return f"{self.key} is {self.there} in training, {self.here} here"


def race_of_policy(
    policy: Policy,
    name: Path | str = "policy",
    config: Path | str | Config | None = None,
    track: str | None = None,
) -> tuple[Config, str]:
    """The config of the race that a policy flies, and where it came from.

    It is ``config``, or else the config in the policy file, without the reward terms of the user's
    that it names: they have no effect on a flight, and are not imported. Files next to it are not
    read.

    Args:
        policy: the policy.
        name: of its file, for messages.
        config: a config, a preset's name or a YAML file that the user names.
        track: a track file that replaces the config's, with its rules.

    Raises:
        InputError: neither of them, a config in the policy file that names code, or a file that
            cannot be read.
    """
    if isinstance(config, Config):
        race, origin = config, "config"
    elif config is not None:
        race, origin = load_config(config), str(config)
    elif policy.config is not None:
        race, origin = stored_config(_flown(policy.config), str(name)), "the policy file's config"
    else:
        raise InputError(
            f"{name}: has no config; name the config of its race (CONFIG or --race CONFIG)"
        )
    if track is not None:
        race = with_track(race, track)
        origin = f"{origin}, track {track}"
    return race, origin


def _flown(tree: Mapping[str, Any]) -> dict[str, Any]:
    """The config in a policy file without the reward terms of the user's."""
    tree = dict(tree)
    if isinstance(reward := tree.get("reward"), dict):
        tree["reward"] = {key: value for key, value in reward.items() if key != "terms"}
    if isinstance(schedules := tree.get("schedules"), dict):
        kept = {key: x for key, x in schedules.items() if not key.startswith("reward.terms")}
        tree["schedules"] = kept
    return tree


def own_race(policy: Policy, race: Config, name: Path | str = "policy") -> Config | None:
    """The vehicle, track, rules and battery of a policy's training, in a config of defaults.

    None for a policy file without a config. Code that ``race`` names, too, is imported.

    Raises:
        InputError: a config that cannot be read, or that names other code.
    """
    if policy.config is None:
        return None
    parts = {key: policy.config[key] for key in (*FLOWN, "evaluate", "run") if key in policy.config}
    return stored_config(parts, str(name), names_of_code(race))


def warn_of_other_race(policy: Policy, race: Config, name: Path | str = "policy") -> None:
    """Warn in one line of a race that differs from the one that a policy was trained in."""
    try:
        own = own_race(policy, race, name)
        found = [] if own is None else list(differences(own, race))
    except InputError as error:
        warn(f"not compared with the race of the training: {error}")
        return
    if found:
        more = [f"{len(found) - MAX_LISTED} more"] if len(found) > MAX_LISTED else []
        listed = "; ".join([*map(str, found[:MAX_LISTED]), *more])
        warn(f"{name}: trained in another race: {listed} (without a config it flies its own race)")


def differences(
    there: Config, here: Config, sections: Sequence[str] = FLOWN
) -> Iterator[Difference]:
    """Where two races differ: by the names of vehicle or track, or else by keys.

    The second vehicle has the model of the first where its file has constants of both.
    """
    model = there.vehicle.model
    if model in here.vehicle.models:
        here = here.replace(vehicle=here.vehicle.with_model(model))
    for section in sections:
        pair = [getattr(race, section) for race in (there, here)]
        names = [getattr(part, "name", "") for part in pair]
        if None in pair and pair != [None, None]:
            yield Difference(section, *("null" if part is None else "given" for part in pair))
            continue
        first, second = (dict(_values(part and part.model_dump(), section)) for part in pair)
        keys = [key for key in {**first, **second} if not _equal(first.get(key), second.get(key))]
        if keys and all(names) and names[0] != names[1]:
            yield Difference(section, *names)
            continue
        for key in keys:
            yield Difference(key, *(_text(values.get(key)) for values in (first, second)))


def _values(node: Any, key: str) -> Iterator[tuple[str, Any]]:
    """The values that describe a flight in a section, by dotted key; of gates one by one."""
    if isinstance(node, dict):
        for name, value in node.items():
            if name not in NOT_FLOWN:
                yield from _values(value, f"{key}.{name}")
    elif isinstance(node, tuple) and node and isinstance(node[0], dict):
        for index, value in enumerate(node):
            yield from _values(value, f"{key}[{index}]")
    else:
        yield key, node


def _equal(first: Any, second: Any) -> bool:
    """Whether two values are equal; residual files with the same networks are."""
    if first == second or not all(
        isinstance(x, str) and x.endswith(".npz") for x in (first, second)
    ):
        return first == second
    leaves = [jax.tree.leaves(read_residual(Path(file))) for file in (first, second)]
    return len(leaves[0]) == len(leaves[1]) and all(map(np.array_equal, *leaves))


def _text(value: Any) -> str:
    return short(value, text=lambda x: f"{x:g}" if isinstance(x, float) else str(x))
