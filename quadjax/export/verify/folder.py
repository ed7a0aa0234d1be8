"""An exported folder, read back: the conversion repeated from the inputs in it."""

import dataclasses
import json
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.files import read_npz
from quadjax.export import conversion
from quadjax.export.conversion import Converted, Request
from quadjax.export.convert import (
    POLICY_FILE,
    ROLLOUTS_ARRAYS,
    ROLLOUTS_FILE,
    ROLLOUTS_FORMAT,
)
from quadjax.export.estimator_tables import EstimatorTables
from quadjax.export.fixed import FixedNetwork
from quadjax.export.flights import Rollouts
from quadjax.export.proof import Proof
from quadjax.export.race_source import CONFIG_FILE, OwnRace
from quadjax.export.race_tables import RaceTables
from quadjax.policy.file import Policy


@dataclasses.dataclass(frozen=True)
class Folder:
    """An exported folder, and the conversion repeated from the inputs in it."""

    path: Path
    converted: Converted
    sources: dict[str, str]  # what the converter writes, by file
    allow_unfinished: bool  # as in the request

    @property
    def name(self) -> str:
        """Prefix of every C symbol and file."""
        return self.converted.origin.name

    @property
    def policy(self) -> Policy:
        """The policy."""
        return self.converted.policy

    @property
    def network(self) -> FixedNetwork:
        """The policy as integers."""
        return self.converted.network

    @property
    def proof(self) -> Proof:
        """The proof of the network."""
        return self.converted.proof

    @property
    def race(self) -> RaceTables:
        """The observation and the gates as integers."""
        return self.converted.race

    @property
    def estimator(self) -> EstimatorTables | None:
        """The disturbance estimator as integers, of a motor-level policy."""
        return self.converted.estimator

    @property
    def own(self) -> OwnRace:
        """The race that the policy was trained in."""
        return self.converted.own

    @property
    def rollouts(self) -> Rollouts:
        """Rows of the simulated flights."""
        return self.converted.rollouts

    @property
    def motor(self) -> bool:
        """Whether commands are rpm."""
        return self.policy.vehicle == "motor"

    @property
    def files(self) -> list[Path]:
        """The C files that compile on any machine."""
        return [self.path / f for f in self.sources if f.endswith(".c") and "/" not in f]


def read_folder(path: Path) -> Folder:
    """Read an exported folder and convert its policy again.

    Raises:
        InputError: no such folder, or a file in it that is missing or damaged.
    """
    reports = sorted(path.glob("*_report.json"))
    if len(reports) != 1:
        raise InputError(f"{path}: expected one *_report.json, found {len(reports)}")
    try:
        report = json.loads(reports[0].read_text("utf-8"))
        file, request = report["policy"], _request(path, report)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{reports[0]}: not a report of quadjax export ({error!r})") from error
    converted = conversion.convert_again(request, file, _rollouts(path / ROLLOUTS_FILE))
    folder = Folder(path, converted, {}, request.allow_unfinished)
    _check_shapes(folder, path / ROLLOUTS_FILE)
    return dataclasses.replace(folder, sources=conversion.sources(converted))


def _rollouts(path: Path) -> Rollouts:
    arrays, _ = read_npz(path, ROLLOUTS_FORMAT, ROLLOUTS_ARRAYS)
    missing = [name for name in ROLLOUTS_ARRAYS if name not in arrays]
    if missing:
        raise InputError(f"{path}: {missing[0]} is missing")
    return Rollouts(*(arrays[name] for name in ROLLOUTS_ARRAYS))


def _check_shapes(folder: Folder, path: Path) -> None:
    """Raise an ``InputError`` for rollouts that do not fit the policy and its track."""
    rows, race = folder.rollouts, folder.race
    count = len(rows.targets) if rows.targets.ndim == 1 else 0
    shapes = (rows.observations.shape, rows.states.shape)
    if not count or shapes != ((count, folder.network.inputs), (count, race.state_size)):
        raise InputError(f"{path}: its arrays do not fit the policy")
    kinds = [rows.observations.dtype.kind, rows.states.dtype.kind, rows.targets.dtype.kind]
    if kinds != ["f", "f", "i"] or not np.all((0 <= rows.targets) & (rows.targets < race.gates)):
        raise InputError(f"{path}: its arrays do not fit the policy")


def _request(path: Path, report: dict) -> Request:
    estimator = report["estimator"] or {}
    return Request(
        policy=path / POLICY_FILE,
        folder=path,
        ranges={str(name): float(value) for name, value in report["ranges"].items()},
        name=str(report["name"]),
        config=path / CONFIG_FILE,
        sample_rate=float(estimator.get("sample_rate", 512.0)),
        cutoff=float(estimator.get("cutoff", 8.0)),
        allow_unfinished=report["allow_unfinished"] is True,
    )
