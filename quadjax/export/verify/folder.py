"""An exported folder, read back: the integers made anew from the inputs that lie in it."""

import dataclasses
import json
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export import convert_policy as conversion
from quadjax.export import flights
from quadjax.export.emit_network import Provenance
from quadjax.export.estimator_tables import EstimatorTables
from quadjax.export.fixed import FixedNetwork
from quadjax.export.proof import Proof
from quadjax.export.race_tables import RaceTables
from quadjax.policy.file import Policy


@dataclasses.dataclass(frozen=True)
class Folder:
    """What a folder of C was made from."""

    path: Path
    name: str
    policy: Policy
    network: FixedNetwork
    proof: Proof
    race: RaceTables
    estimator: EstimatorTables | None
    own: flights.OwnRace
    observations: np.ndarray  # (n, inputs) float32, flown
    states: np.ndarray  # (n, state_size) float32, flown
    targets: np.ndarray  # (n,) int32
    sources: dict[str, str]  # what the converter writes, by file
    origin: Provenance

    @property
    def files(self) -> list[Path]:
        """The C files that compile on any machine."""
        return [self.path / f for f in self.sources if f.endswith(".c") and "/" not in f]


def read_folder(path: Path) -> Folder:
    """Read an exported folder and convert its policy again.

    Raises:
        InputError: no such folder, or what lies in it is not what the converter left there.
    """
    reports = sorted(path.glob("*_report.json"))
    if len(reports) != 1:
        raise InputError(f"{path}: expected one *_report.json, found {len(reports)}")
    try:
        report = json.loads(reports[0].read_text("utf-8"))
        request = _request(path, report)
        with np.load(path / conversion.FLOWN_FILE) as archive:
            flown = {name: archive[name] for name in ("observations", "states", "targets")}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: is not what export_c.py wrote ({error})") from error
    converted = conversion.convert_again(request, report, flown)
    return Folder(
        path=path,
        name=report["name"],
        policy=converted.policy,
        network=converted.network,
        proof=converted.proof,
        race=converted.race,
        estimator=converted.estimator,
        own=converted.own,
        observations=flown["observations"],
        states=flown["states"],
        targets=flown["targets"],
        sources=conversion.sources(converted),
        origin=converted.origin,
    )


def _request(path: Path, report: dict) -> conversion.Request:
    estimator = report["estimator"] or {}
    return conversion.Request(
        policy=path / conversion.POLICY_FILE,
        out=path,
        ranges=report["ranges"],
        name=report["name"],
        config=path / conversion.CONFIG_FILE,
        sample_rate=estimator.get("sample_rate", 512.0),
        cutoff=estimator.get("cutoff", 8.0),
    )
