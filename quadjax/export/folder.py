"""The folder of an export read back: the conversion is repeated from the inputs in it."""

import dataclasses
from pathlib import Path

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import check_file, read_json
from quadjax.export.conversion import Converted, Options, convert_policy, sha256
from quadjax.export.estimators import check_cutoff
from quadjax.export.names import CONFIG_FILE, POLICY_FILE, report_of, symbol_name
from quadjax.export.race_source import policy_race
from quadjax.export.report import report_text
from quadjax.export.targets import find_target
from quadjax.policy.file import Policy


def read_folder(path: Path, config: Config | Path | str | None = None) -> Converted:
    """Read an exported folder, convert its policy again, and compare the files with the result.

    Args:
        path: of the folder.
        config: of its race, named by the user; None: ``config.yaml`` of the folder, which may not
            name code.

    Raises:
        InputError: no such folder, or a file in it that is missing, damaged or not what the
            converter writes.
    """
    report = report_of(path)
    options, file, text, config_hash = _read_report(report)
    policy = Policy.load(path / POLICY_FILE)
    if sha256(path / CONFIG_FILE) != config_hash:
        raise InputError(f"{path / CONFIG_FILE}: not the one that {report.name} names")
    if config is None:
        config = load_config(path / CONFIG_FILE, code=())
    elif not isinstance(config, Config):
        config = load_config(config)
    race = policy_race(config, policy, CONFIG_FILE, file)
    converted = convert_policy(policy, race, options, file, path / POLICY_FILE)
    texts = {f"{options.name}_report.txt": text.encode("utf-8")}
    for name, content in (converted.files | texts).items():
        check_file(path / name)
        if (path / name).read_bytes() != content:
            raise InputError(
                f"{path / name}: not what the converter writes for this policy and race; nothing "
                "is compiled"
            )
    return converted


def _read_report(path: Path) -> tuple[Options, str, str, str]:
    """The options, the name of the policy file, the report as text, the config's SHA-256."""
    report = read_json(path)
    try:
        options, file = Options(**report["options"]), str(report["policy"])
        ranges = {str(name): float(value) for name, value in options.ranges.items()}
        rate, cutoff = float(options.sample_rate), float(options.cutoff)
        check_cutoff(rate, cutoff)
        symbol_name(options.name, file)
        find_target(options.target)
        text, config_hash = report_text(report, options.name), str(report["config_sha256"])
    except Exception as error:  # of any type, because the values can be anything
        fault = str(error) if isinstance(error, InputError) else repr(error)
        fault = f"{error} is missing" if isinstance(error, KeyError) else fault
        raise InputError(f"{path}: not a report of quadjax export ({fault:.200})") from error
    options = dataclasses.replace(options, ranges=ranges, sample_rate=rate, cutoff=cutoff)
    return options, file, text, config_hash
