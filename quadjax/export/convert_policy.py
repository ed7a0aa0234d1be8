"""The whole conversion: from a policy file to a folder of C with its proof and its vectors."""

import dataclasses
import hashlib
import itertools
import shutil
import textwrap
from pathlib import Path

import numpy as np

from quadjax.config.loading import to_yaml
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import whole_file, write_json, write_text
from quadjax.export import flights
from quadjax.export.emit_estimator import emit_estimator
from quadjax.export.emit_network import Provenance, emit_network
from quadjax.export.emit_paparazzi import emit_paparazzi
from quadjax.export.emit_race import emit_race, self_test_states
from quadjax.export.estimator_tables import EstimatorTables, make_estimator
from quadjax.export.fixed import FORMAT_VERSION, FixedNetwork, convert
from quadjax.export.proof import Proof, prove
from quadjax.export.race_tables import RaceTables, make_tables
from quadjax.export.render import identifier
from quadjax.export.report import make_report, measure, report_text
from quadjax.export.vectors import self_test_inputs
from quadjax.policy.file import Policy, read_policy
from quadjax.vehicle.residual_file import located

FLIGHTS = 32
KEPT_ROWS = 20_000  # flown rows that go along for the verification
BOX_SAMPLES = 20_000
COMMENT_WIDTH = 96
POLICY_FILE, RESIDUAL_FILE = "policy.npz", "residual.npz"
CONFIG_FILE, FLOWN_FILE = "config.yaml", "flown.npz"


@dataclasses.dataclass(frozen=True)
class Request:
    """What was asked of the converter."""

    policy: Path
    out: Path
    ranges: dict[str, float]
    name: str | None = None
    track: str | None = None  # a file of configs/tracks, or a path
    config: Path | None = None  # the training config, or the project's default
    sample_rate: float = 512.0  # Hz, of the estimator
    cutoff: float = 8.0  # Hz


@dataclasses.dataclass(frozen=True)
class Converted:
    """All that the emitted files are made from."""

    policy: Policy
    network: FixedNetwork
    proof: Proof
    race: RaceTables
    estimator: EstimatorTables | None
    kept: flights.Flown  # evenly spread rows of the flights
    steps_flown: int
    own: flights.OwnRace
    origin: Provenance
    residual_hash: str


def sha256(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def convert_policy(request: Request) -> Converted:
    """Convert and prove; fly; refuse what must not fly.

    Raises:
        InputError: whatever is wrong, in one line.
    """
    policy = read_policy(request.policy)
    network = convert(policy, request.ranges)
    proof = prove(network, policy)
    own = flights.own_race(policy, request.config, request.track)
    origin = _origin(request, request.policy.name, policy, own)
    flown = flights.fly(own, policy, FLIGHTS)
    flights.check_box(network.box, flown.observations)
    rows = np.linspace(0, len(flown.states) - 1, min(KEPT_ROWS, len(flown.states))).astype(int)
    kept = flights.Flown(
        flown.observations[rows], flown.states[rows], flown.targets[rows], flown.laps
    )
    return _complete(request, policy, network, proof, own, kept, len(flown.states), origin)


def convert_again(request: Request, report: dict, flown: dict[str, np.ndarray]) -> Converted:
    """The conversion once more from what lies in a folder, without flying.

    Raises:
        InputError: whatever is wrong, in one line.
    """
    policy = read_policy(request.policy)
    network = convert(policy, request.ranges)
    proof = prove(network, policy)
    own = flights.own_race(policy, request.config, None, request.out / RESIDUAL_FILE)
    kept = flights.Flown(flown["observations"], flown["states"], flown["targets"], None)
    origin = _origin(request, report["policy"], policy, own)
    return _complete(request, policy, network, proof, own, kept, 0, origin)


def _complete(
    request: Request,
    policy: Policy,
    network: FixedNetwork,
    proof: Proof,
    own: flights.OwnRace,
    kept: flights.Flown,
    steps_flown: int,
    origin: Provenance,
) -> Converted:
    estimator, residual_hash = _estimator(request, own)
    return Converted(
        policy=policy,
        network=network,
        proof=proof,
        race=make_tables(network, policy, own.params.track, own.choices.gate_test == "world_box"),
        estimator=estimator,
        kept=kept,
        steps_flown=steps_flown,
        own=own,
        origin=origin,
        residual_hash=residual_hash,
    )


def _estimator(request: Request, own: flights.OwnRace) -> tuple[EstimatorTables | None, str]:
    vehicle = own.params.vehicle
    if own.choices.model.balance is None:
        return None, ""  # a rate-level policy does not see the disturbances
    residual = own.config.vehicle.residual
    tables = make_estimator(
        vehicle.constants, vehicle.residual, request.sample_rate, request.cutoff
    )
    return tables, sha256(located(residual)) if residual else ""


def _name(request: Request, file: str) -> str:
    """The prefix of every C symbol: as asked for, or the policy file's name."""
    name = request.name if request.name is not None else identifier(Path(file).stem)
    if identifier(name) != name:
        raise InputError(f"--name {name!r}: expected a lower-case C identifier")
    return name


def _origin(request: Request, file: str, policy: Policy, own: flights.OwnRace) -> Provenance:
    policy_hash = sha256(request.policy)
    said = {k: v for k, v in policy.source.items() if v is not None and not isinstance(v, dict)}
    source = ", ".join(f"{key}={value}" for key, value in said.items())
    track, vehicle = (
        part.name or Path(part.file).name for part in (own.config.track, own.config.vehicle)
    )
    facts = (
        f"Policy   {file}, SHA-256 {policy_hash}",
        f"Source   {source or 'not stated in the policy file'}",
        f"Format   quadjax fixed point, version {FORMAT_VERSION}; deterministic (mean) actions",
        f"Track    {track}; vehicle {vehicle}",
    )
    lines = [textwrap.wrap(fact, COMMENT_WIDTH, subsequent_indent=" " * 9) for fact in facts]
    name = _name(request, file)
    return Provenance(name, policy_hash, tuple(itertools.chain(*lines)), source or file)


def sources(converted: Converted) -> dict[str, str]:
    """Every emitted C file and header, by its path in the folder."""
    network, origin, flown = converted.network, converted.origin, converted.kept
    files = emit_network(network, origin, self_test_inputs(network, flown.observations))
    states, targets = self_test_states(converted.race, flown.states, flown.targets)
    kind = "uint16_t" if network.vehicle == "motor" else "float"
    files |= emit_race(converted.race, origin, kind, states, targets)
    if converted.estimator is not None:
        files |= emit_estimator(converted.estimator, origin, converted.residual_hash)
    return files | emit_paparazzi(network, origin)


def report_of(converted: Converted, request: Request) -> dict[str, object]:
    """The report as JSON takes it; it is also how the folder can be verified again."""
    network, policy, flown = converted.network, converted.policy, converted.kept
    rng = np.random.default_rng(0)
    shape = (BOX_SAMPLES, network.inputs)
    box = (rng.uniform(-1.0, 1.0, shape) * network.box.ranges).astype(np.float32)
    measured = {
        "the whole box": measure(network, policy, box),
        "flown": measure(network, policy, flown.observations),
    }
    extra = {
        "policy": request.policy.name,
        "policy_sha256": converted.origin.policy_hash,
        "source": policy.source,
        "name": converted.origin.name,
        "track": converted.own.config.track.name,
        "deterministic": True,
        "ranges": request.ranges,
        "estimator": _estimator_report(converted),
        "flights": {
            "runs": len(flown.laps.crashes),
            "finished": flown.laps.finished,
            "laps": flown.laps.lap_times.shape[1],
            "observations": converted.steps_flown,
        },
    }
    return make_report(network, converted.proof, measured, extra)


def _estimator_report(converted: Converted) -> dict[str, object] | None:
    tables = converted.estimator
    if tables is None:
        return None
    return {
        "sample_rate": tables.sample_rate,
        "cutoff": tables.cutoff,
        "residual_sha256": converted.residual_hash,
        "channel_ranges": [2.0**e for e in tables.channel_exponents],
    }


def write_folder(request: Request) -> tuple[Converted, dict[str, object]]:
    """Convert, and write the C, the report and what the verification needs.

    Raises:
        InputError: whatever is wrong, in one line; then nothing has been written.
    """
    _check_out(request)
    converted = convert_policy(request)
    report = report_of(converted, request)
    name, out = converted.origin.name, request.out
    files = sources(converted)
    for file, text in files.items():
        write_text(out / file, text)
    for file in {f"{name}_estimator.c", f"{name}_estimator.h"} - files.keys():
        (out / file).unlink(missing_ok=True)  # of a policy that saw the disturbances
    write_json(out / f"{name}_report.json", report)
    write_text(out / f"{name}_report.txt", report_text(report, name))
    _keep_inputs(converted, request)
    return converted, report


def _check_out(request: Request) -> None:
    """Refuse an output that is no folder, or one that holds the export of another name."""
    name, out = _name(request, request.policy.name), request.out
    if out.exists() and not out.is_dir():
        raise InputError(f"--out {out}: is no folder")
    others = sorted({path.name for path in out.glob("*_report.json")} - {f"{name}_report.json"})
    if others:
        other = others[0].removesuffix("_report.json")
        raise InputError(
            f"--out {out}: holds an export named {other!r}; take another folder, or delete that one"
        )


def _by_itself(config: Config, out: Path) -> Config:
    """The config with copies in ``out`` of a track or vehicle file of the user's own."""
    for section in ("track", "vehicle"):
        part = getattr(config, section)
        source = Path(part.file)
        if source.is_absolute():
            if source.resolve() != (out / source.name).resolve():
                write_text(out / source.name, source.read_text("utf-8"))
            part = dataclasses.replace(part, file=source.name)
            config = dataclasses.replace(config, **{section: part})
    return config


def _keep_inputs(converted: Converted, request: Request) -> None:
    """What the verification needs to make it all again: policy, config, residual and flights."""
    out, kept = request.out, converted.kept
    copies = {POLICY_FILE: request.policy}
    config = converted.own.config
    if config.vehicle.residual:
        copies[RESIDUAL_FILE] = located(config.vehicle.residual)
    for name, source in copies.items():
        if source.resolve() != (out / name).resolve():
            with whole_file(out / name) as temporary:
                shutil.copyfile(source, temporary)
    if RESIDUAL_FILE not in copies:
        (out / RESIDUAL_FILE).unlink(missing_ok=True)
    write_text(out / CONFIG_FILE, to_yaml(_by_itself(config, out)))
    with whole_file(out / FLOWN_FILE) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(
            stream,
            observations=kept.observations,
            states=kept.states,
            targets=kept.targets.astype(np.int32),
        )
