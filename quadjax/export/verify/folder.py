"""An exported folder, read back: the conversion repeated from the inputs in it."""

import dataclasses
from pathlib import Path

import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import check_file, read_json, read_npz
from quadjax.core.folders import check_kind
from quadjax.export.conversion import Converted, Options, convert_policy, sha256, symbol_name
from quadjax.export.convert import (
    KIND,
    POLICY_FILE,
    ROLLOUTS_ARRAYS,
    ROLLOUTS_FILE,
    ROLLOUTS_FORMAT,
)
from quadjax.export.flights import Rollouts
from quadjax.export.race_source import CONFIG_FILE, OwnRace, own_race
from quadjax.export.race_tables import state_sizes
from quadjax.export.report import report_text
from quadjax.export.targets import find_target
from quadjax.policy.file import Policy


@dataclasses.dataclass(frozen=True)
class Folder(Converted):
    """An exported folder: the conversion repeated from the inputs in it."""

    path: Path


@dataclasses.dataclass(frozen=True)
class Inputs:
    """What an exported folder was made from."""

    options: Options
    policy: Policy
    config: Config
    own: OwnRace
    file: str  # name of the policy file
    text: str  # the report


def read_inputs(path: Path, config: Config | Path | str | None = None) -> Inputs:
    """The inputs of an exported folder, without its sources.

    Args:
        path: of the folder.
        config: of its race, named by the user; None: ``config.yaml`` of the folder, which may not
            name code.

    Raises:
        InputError: no such folder, or a file in it that is missing or damaged.
    """
    check_kind(path, KIND)
    if not path.is_dir():
        raise InputError(f"{path}: no such folder")
    reports = sorted(path.glob("*_report.json"))
    if len(reports) != 1:
        raise InputError(f"{path}: expected one *_report.json, found {len(reports)}")
    options, file, text, config_hash = _read_report(reports[0])
    policy = Policy.load(path / POLICY_FILE)
    check_file(path / CONFIG_FILE)
    if sha256(path / CONFIG_FILE) != config_hash:
        raise InputError(f"{path / CONFIG_FILE}: not the one that {reports[0].name} names")
    if config is None:
        config = load_config(path / CONFIG_FILE, code=())
    elif not isinstance(config, Config):
        config = load_config(config)
    own = own_race(config, policy, CONFIG_FILE, file)
    return Inputs(options, policy, config, own, file, text)


def read_folder(path: Path, config: Config | Path | str | None = None) -> Folder:
    """Read an exported folder, convert its policy again, and compare the files with the result.

    Args:
        path: of the folder.
        config: as of ``read_inputs``.

    Raises:
        InputError: no such folder, or a file in it that is missing, damaged or not what the
            converter writes.
    """
    inputs = read_inputs(path, config)
    policy, own, options, file = inputs.policy, inputs.own, inputs.options, inputs.file
    rollouts = _rollouts(path / ROLLOUTS_FILE)
    _check_shapes(rollouts, policy, own, path / ROLLOUTS_FILE)
    converted = convert_policy(policy, own, options, file, path / POLICY_FILE, rollouts)
    report = {f"{options.name}_report.txt": inputs.text.encode("utf-8")}
    for name, content in (converted.files() | report).items():
        check_file(path / name)
        if (path / name).read_bytes() != content:
            raise InputError(
                f"{path / name}: not what the converter writes for this policy and race; nothing "
                "is compiled"
            )
    fields = (field.name for field in dataclasses.fields(Converted))
    return Folder(**{name: getattr(converted, name) for name in fields}, path=path)


def _read_report(path: Path) -> tuple[Options, str, str, str]:
    """The options, the name of the policy file, the report as text, the config's SHA-256."""
    report = read_json(path)
    try:
        options, file = Options(**report["options"]), str(report["policy"])
        ranges = {str(name): float(value) for name, value in options.ranges.items()}
        numbers = {name: float(getattr(options, name)) for name in ("sample_rate", "cutoff")}
        symbol_name(options.name, file)
        find_target(options.target)
        text, config_hash = report_text(report, options.name), str(report["config_sha256"])
    except Exception as error:  # of any type, because the values can be anything
        raise InputError(f"{path}: not a report of quadjax export ({error!r:.200})") from error
    return dataclasses.replace(options, ranges=ranges, **numbers), file, text, config_hash


def _rollouts(path: Path) -> Rollouts:
    arrays, _ = read_npz(path, ROLLOUTS_FORMAT, ROLLOUTS_ARRAYS)
    missing = [name for name in ROLLOUTS_ARRAYS if name not in arrays]
    if missing:
        raise InputError(f"{path}: {missing[0]} is missing")
    return Rollouts(*(arrays[name] for name in ROLLOUTS_ARRAYS))


def _check_shapes(rows: Rollouts, policy: Policy, own: OwnRace, path: Path) -> None:
    """Raise an ``InputError`` for rollouts that do not fit the policy and its track."""
    parts = (rows.observations, rows.states, rows.targets)
    count, size = (
        rows.targets.size,
        sum(state_sizes(own.choices.layout, own.choices.model).values()),
    )
    wanted = [(count, policy.layout.size), (count, size), (count,)]
    fits = count > 0 and [part.shape for part in parts] == wanted
    fits = fits and [part.dtype.kind for part in parts] == ["f", "f", "i"]
    gates = len(own.params.track.yaw)
    if not fits or not np.all((0 <= rows.targets) & (rows.targets < gates)):
        raise InputError(f"{path}: its arrays do not fit the policy")
