"""The public function of the exporter: a policy to a folder of C."""

import contextlib
import dataclasses
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from quadjax.config.schema import Config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.errors import InputError, writing
from quadjax.core.files import whole_file, write_bytes, write_json
from quadjax.core.folders import claim, replacement
from quadjax.core.precision import single_precision
from quadjax.core.provenance import provenance
from quadjax.core.resources import policy_file
from quadjax.export import emulator, flights
from quadjax.export.conversion import Converted, Options, convert_policy
from quadjax.export.estimators import CUTOFF, SAMPLE_RATE, check_cutoff
from quadjax.export.flights import SEED
from quadjax.export.names import (
    CONFIG_FILE,
    KIND,
    POLICY_FILE,
    REPORT,
    RESIDUAL_FILE,
    check_new_folder,
    symbol_name,
)
from quadjax.export.network import check_policy
from quadjax.export.race_source import check_race, policy_race
from quadjax.export.report import Json, make_report, report_summary, report_text
from quadjax.export.suitability import target_of
from quadjax.export.targets import DEFAULT_TARGET, TARGETS, find_target, runtime_files
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy, warn_of_other_race

FOLDERS = tuple(dict.fromkeys(target.folder for target in TARGETS.values()))


@dataclasses.dataclass(frozen=True)
class Export:
    """The result of ``export_c``."""

    folder: Path
    converted: Converted
    report: Json  # as in the folder's ``NAME_report.json``
    observations: np.ndarray  # (n, inputs) float32 of the policy's own simulated flights

    def __repr__(self) -> str:
        """One line: the name of the files and their folder."""
        return f"Export({self.name!r} in {self.folder})"

    @property
    def name(self) -> str:
        """Name of the files."""
        return self.converted.options.name

    @property
    def text(self) -> str:
        """The report as text."""
        return report_text(self.report, self.name)

    @property
    def summary(self) -> str:
        """The main numbers of the report, in three lines."""
        return report_summary(self.report, self.name)

    def commands(self, observations: np.ndarray) -> np.ndarray:
        """The C's commands (n, k), in the vehicle's unit, of observations (n, inputs).

        The observations are as ``Policy.mean`` takes them; the result has the bits of the C.
        """
        return emulator.commands(self.converted.in_c.network, observations)


@single_precision
def export_c(
    policy: Policy | Path | str,
    folder: Path | str,
    config: Path | str | Config | None = None,
    ranges: dict[str, float] | None = None,
    name: str | None = None,
    *,
    track: str | None = None,
    sample_rate: float | None = None,
    cutoff: float | None = None,
    allow_unfinished: bool = False,
    allow_other_race: bool = False,
    target: str = DEFAULT_TARGET,
    overwrite: bool = False,
    sampled: bool = False,
) -> Export:
    """Write a policy as constant arrays in C, with the runtime and an autopilot's files.

    The network is converted to integers, the conversion is proven for every input in the declared
    ranges, and the policy's own race is simulated. Nothing is written unless all of that succeeds.

    Args:
        policy: a policy or the path of a policy file.
        folder: where the C goes.
        config: the race that the policy was trained in: a config or the path of one.
            Without it: the config in the policy file.
        ranges: half-widths of the inputs that differ from the defaults, powers of two, by name:
            ``{"position": 16.0}``.
        name: name of the header and of the policy in it; the policy file's name by default.
        track: a track file that replaces the config's.
        sample_rate: sample rate of the estimators on board, Hz; 512 by default.
        cutoff: cut-off of the disturbance estimator's low-pass, Hz; 8 by default.
        allow_unfinished: export a policy although it does not finish its own race.
        allow_other_race: export for a race that differs from the one in the policy file.
        target: processor and autopilot, a name of ``targets.TARGETS``.
        overwrite: replace an earlier export of the same name, or write to a folder that no export
            made, and replace its files of the same names.
        sampled: the C samples the actions with the noise of the training, as the paper's policy
            does; the mean action otherwise.

    Returns:
        The numbers in C, the proof and the report.

    Raises:
        InputError: no such target; a sample rate or cut-off out of range, or one for a policy
            without an estimator on board; a policy that cannot be converted, that leaves its
            declared ranges, or of which fewer than 90% of the simulated flights finish; a race that
            differs from that of the policy file; a folder that cannot be written, or that holds an
            export.
    """
    rates = (
        SAMPLE_RATE if sample_rate is None else sample_rate,
        CUTOFF if cutoff is None else cutoff,
    )
    check_cutoff(*rates)
    find_target(target)
    enable_compilation_cache()
    folder = Path(folder)
    file = POLICY_FILE if isinstance(policy, Policy) else policy_file(policy).name
    symbol = symbol_name(name, file)
    inputs = (POLICY_FILE, RESIDUAL_FILE, CONFIG_FILE)
    files = (*inputs, f"{symbol}[._]*", *FOLDERS)
    check_new_folder(folder, symbol, overwrite)
    with _policy_file(policy) as path, claim(folder, KIND, files, overwrite):
        numbers = (ranges or {}, *rates)
        allowed = (allow_unfinished, allow_other_race)
        options = Options(symbol, *numbers, *allowed, target, sampled)
        converted = convert_file(path, options, config, track)
        _check_rates(converted, sample_rate, cutoff)
        rollouts = flights.simulate(converted.race)
        if not allow_unfinished:
            flights.check_finished(rollouts.laps, converted.race, converted.file)
        converted.in_c.network.box.check(rollouts.observations)
        source = provenance(converted.race.config, path, SEED)
        rollouts = rollouts.thinned()
        report = make_report(converted, rollouts) | {"provenance": source}
        export = Export(folder, converted, report, rollouts.observations)
        with writing(folder), replacement(folder, _optional(symbol)) as new:
            _write(export, new, path)
        _remove_empty(folder)
    return export


def convert_file(
    path: Path,
    options: Options,
    config: Path | str | Config | None = None,
    track: str | None = None,
) -> Converted:
    """Convert a policy file, without simulated flights; the arguments are those of ``export_c``."""
    policy = Policy.load(path)
    check_policy(policy)
    target_of(options.target, policy.vehicle)
    config, origin = race_of_policy(policy, path.name, config, track)
    if options.allow_other_race:
        warn_of_other_race(policy, config, path.name)
    race = policy_race(config, policy, origin, path.name)
    if not options.allow_other_race:
        check_race(policy, race, path)
    return convert_policy(policy, race, options, path.name, path)


def _check_rates(converted: Converted, sample_rate: float | None, cutoff: float | None) -> None:
    """Reject options of estimators that the policy does not have."""
    in_c = converted.in_c
    used = {"sample rate": in_c.disturbance or in_c.battery, "cut-off": in_c.disturbance}
    for (name, tables), value in zip(used.items(), (sample_rate, cutoff), strict=True):
        if value is not None and tables is None:
            raise InputError(
                f"estimator {name} {value:g} Hz has no effect: the policy observes no disturbance "
                f"that is estimated on board (vehicle model {converted.policy.vehicle!r})"
            )


@contextlib.contextmanager
def _policy_file(policy: Policy | Path | str) -> Iterator[Path]:
    """The path of a policy file; a policy in memory is written to a temporary one."""
    if not isinstance(policy, Policy):
        yield policy_file(policy)
        return
    with tempfile.TemporaryDirectory() as folder:
        policy.save(Path(folder) / POLICY_FILE)
        yield Path(folder) / POLICY_FILE


def _optional(name: str) -> tuple[str, ...]:
    """Files that not every export writes; those of an earlier export are removed."""
    files = []
    for target in TARGETS.values():
        sources = ("qj_sizes.h", "quadjax_policy.h", f"{name}.h")
        files += [*runtime_files(target), *(f"{target.folder}/{file}" for file in sources)]
    return (*dict.fromkeys(files), RESIDUAL_FILE)


def _remove_empty(folder: Path) -> None:
    """Remove the folders of an earlier export that have no file left."""
    for top in FOLDERS:
        for path in sorted([folder / top, *(folder / top).rglob("*")], reverse=True):
            if path.is_dir() and not path.is_symlink():
                with contextlib.suppress(OSError):
                    path.rmdir()


def _write(export: Export, folder: Path, policy: Path) -> None:
    """The C, the report, and the inputs from which the verification repeats the conversion."""
    converted, name = export.converted, export.name
    files = converted.files | {
        f"{name}_report.txt": export.text.encode(),
        CONFIG_FILE: converted.race.text.encode(),
    }
    for file, data in files.items():
        write_bytes(folder / file, data)
    for file, source in ((POLICY_FILE, policy), (RESIDUAL_FILE, converted.race.residual)):
        if source is not None:
            with whole_file(folder / file) as temporary:
                shutil.copyfile(source, temporary)
    write_json(folder / f"{name}{REPORT}", export.report)
