"""The report beside the C: what was proven and measured, as JSON and as a table."""

import dataclasses

import numpy as np

from quadjax.export import emulator
from quadjax.export.fixed import FORMAT_VERSION, FixedNetwork
from quadjax.export.proof import Proof
from quadjax.export.ranges import UNITS
from quadjax.policy.file import Policy


@dataclasses.dataclass(frozen=True)
class Measured:
    """Errors against float64 that were measured, in the command's unit."""

    samples: int
    largest: list[float]  # per output
    median: float


def float64_commands(policy: Policy, observations: np.ndarray) -> np.ndarray:
    """Commands (n, 4) of the real-valued policy, in float64."""
    y = np.asarray(observations, np.float64)
    for index, (kernel, bias) in enumerate(policy.layers):
        y = y @ np.asarray(kernel, np.float64) + np.asarray(bias, np.float64)
        if index < len(policy.layers) - 1:
            y = np.maximum(y, 0.0)
    action = np.tanh(y) if policy.output == "tanh" else np.clip(y, -1.0, 1.0)
    low, high = policy.command_low, policy.command_high
    return low + 0.5 * (high - low) * (action + 1.0)


def measure(network: FixedNetwork, policy: Policy, observations: np.ndarray) -> Measured:
    """Errors of the fixed-point policy over observations (n, inputs) within the box."""
    found = emulator.commands(network, observations)
    error = np.abs(found - float64_commands(policy, observations))
    return Measured(len(observations), error.max(axis=0).tolist(), float(np.median(error)))


def make_report(
    network: FixedNetwork, proof: Proof, measured: dict[str, Measured], extra: dict[str, object]
) -> dict[str, object]:
    """The report as JSON takes it."""
    box = network.box
    layers = []
    for index, rows in enumerate(proof.rows):
        magnitude = max(row.magnitude for row in rows)
        hidden = index < len(network.hidden)
        layers.append(
            {
                "rows": len(rows),
                "columns": int(network.layers[index].weights.shape[1]),
                "largest_accumulator": str(magnitude),
                "accumulator_bits": round(proof.accumulator_bits[index], 4),
                "largest_output": max(max(0, row.high >> 32) for row in rows) if hidden else None,
                "never_active": proof.inactive[index] if hidden else None,
            }
        )
    unit = 2.0**network.fraction_bits
    return {
        "format_version": FORMAT_VERSION,
        "vehicle": network.vehicle,
        "output": network.squash,
        "inputs": [
            {"name": name, "range": float(limit), "unit": UNITS[name.split("[")[0]]}
            for name, limit in zip(box.names, box.ranges, strict=True)
        ],
        "fraction_bits": network.fraction_bits,
        "command_low": (network.command_low / unit).tolist(),
        "command_high": (network.command_high / unit).tolist(),
        "layers": layers,
        "error_bound": proof.error_bound.tolist(),
        "measured_error": {name: dataclasses.asdict(m) for name, m in measured.items()},
        **extra,
    }


def report_text(report: dict, name: str) -> str:
    """The report as a table to read."""
    lines = [f"{name}: fixed-point policy, format version {report['format_version']}", ""]
    lines += [
        f"{key}: {report[key]}" for key in ("policy", "policy_sha256", "track") if key in report
    ]
    lines += ["", "Inputs, and the range that every proof below holds for:"]
    for index, entry in enumerate(report["inputs"]):
        lines.append(f"  {index:2d}  {entry['name']:<17} +-{entry['range']:g} {entry['unit']}")
    lines += ["", "Proven for every input in those ranges, by intervals of exact integers:"]
    lines.append("  layer   rows  columns  largest |sum|   of 2^63   largest output  never active")
    for index, layer in enumerate(report["layers"]):
        largest = "-" if layer["largest_output"] is None else str(layer["largest_output"])
        never = "-" if layer["never_active"] is None else str(layer["never_active"])
        share = 100.0 * int(layer["largest_accumulator"]) / 2.0**63
        lines.append(
            f"  {index:5d}  {layer['rows']:5d}  {layer['columns']:7d}"
            f"  2^{layer['accumulator_bits']:<11.3f}  {share:6.2f}%  {largest:>15}  {never:>12}"
        )
    lines += _errors(report)
    return "\n".join(lines) + "\n"


def _errors(report: dict) -> list[str]:
    unit = "rpm" if report["vehicle"] == "motor" else "rad/s and m/s^2"
    bound = ", ".join(f"{x:.3g}" for x in report["error_bound"])
    lines = ["", f"Error against real arithmetic, {unit}:"]
    lines.append(f"  proven for every input      {bound}")
    for name, m in report["measured_error"].items():
        largest = ", ".join(f"{x:.3g}" for x in m["largest"])
        lines.append(f"  measured, {name:<17} {largest} (of {m['samples']} samples)")
    low, high = report["command_low"], report["command_high"]
    lines.append("")
    lines.append(f"Commands, whatever the input: {min(low):g} .. {max(high):g} {unit}")
    flights = report.get("flights")
    if flights:
        lines.append(
            f"Flights: {flights['finished']} of {flights['runs']} finished {flights['laps']} laps; "
            f"{flights['observations']} observations, none outside the ranges"
        )
    return lines
