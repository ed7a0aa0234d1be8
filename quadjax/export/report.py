"""The report that accompanies the C: what is proven and what was measured, as JSON and as text."""

import jax.numpy as jnp
import numpy as np

from quadjax.core import mlp
from quadjax.export import emulator
from quadjax.export.conversion import Converted, Request
from quadjax.export.fixed import FORMAT_VERSION, FixedNetwork
from quadjax.export.integers import WORD, enable_x64
from quadjax.export.render import render
from quadjax.policy.file import Policy

BOX_SAMPLES = 20_000

Json = dict[str, object]


def float64_commands(policy: Policy, observations: np.ndarray) -> np.ndarray:
    """Commands (n, 4) of the real-valued policy, in float64."""
    with enable_x64(True):
        layers = [tuple(jnp.asarray(x, jnp.float64) for x in layer) for layer in policy.layers]
        y = np.asarray(mlp.apply(layers, jnp.asarray(observations, jnp.float64), "relu"))
    low, high = policy.command_low, policy.command_high
    return low + 0.5 * (high - low) * (np.clip(y, -1.0, 1.0) + 1.0)


def make_report(converted: Converted, request: Request) -> Json:
    """The report as JSON takes it; the verification reads the request from it."""
    network, policy, rollouts = converted.network, converted.policy, converted.rollouts
    box = network.box
    rng = np.random.default_rng(0)
    shape = (BOX_SAMPLES, network.inputs)
    samples = (rng.uniform(-1.0, 1.0, shape) * box.ranges).astype(np.float32)
    measured = {"the whole box": samples, "simulated": rollouts.observations}
    unit = 2.0**network.fraction_bits
    laps = rollouts.laps
    return {
        "format_version": FORMAT_VERSION,
        "vehicle": network.vehicle,
        "inputs": [
            {"name": name, "range": float(limit), "unit": unit}
            for name, limit, unit in zip(box.names, box.ranges, box.units, strict=True)
        ],
        "fraction_bits": network.fraction_bits,
        "command_low": (network.command_low / unit).tolist(),
        "command_high": (network.command_high / unit).tolist(),
        "layers": [_layer(converted, index) for index in range(len(network.layers))],
        "error_bound": converted.proof.error_bound.tolist(),
        "measured_error": {name: _measure(network, policy, x) for name, x in measured.items()},
        "policy": request.policy.name,
        "policy_sha256": converted.origin.policy_hash,
        "source": policy.source,
        "name": converted.origin.name,
        "track": converted.own.config.track.name,
        "config": converted.own.origin,
        "deterministic": True,
        "ranges": request.ranges,
        "allow_unfinished": request.allow_unfinished,
        "estimator": _estimator(converted),
        "flights": {
            "runs": len(laps.crashes),
            "finished": laps.finished,
            "laps": laps.lap_times.shape[1],
            "observations": rollouts.steps,
        },
    }


def _layer(converted: Converted, index: int) -> Json:
    """What is proven of a layer."""
    rows, proof = converted.proof.rows[index], converted.proof
    hidden = index < len(converted.network.hidden)
    return {
        "rows": len(rows),
        "columns": int(converted.network.layers[index].weights.shape[1]),
        "largest_accumulator": str(max(row.magnitude for row in rows)),
        "accumulator_bits": round(proof.accumulator_bits[index], 4),
        "largest_output": max(max(0, row.high >> WORD) for row in rows) if hidden else None,
        "never_active": proof.inactive[index] if hidden else None,
    }


def _measure(network: FixedNetwork, policy: Policy, observations: np.ndarray) -> Json:
    """Errors of the fixed-point policy over observations (n, inputs), in the command's unit."""
    error = np.abs(
        emulator.commands(network, observations) - float64_commands(policy, observations)
    )
    return {
        "samples": len(observations),
        "largest": error.max(axis=0).tolist(),
        "median": float(np.median(error)),
    }


def _estimator(converted: Converted) -> Json | None:
    tables = converted.estimator
    if tables is None:
        return None
    return {
        "sample_rate": tables.sample_rate,
        "cutoff": tables.cutoff,
        "residual_sha256": converted.residual_hash,
        "channel_ranges": [2.0**e for e in tables.channel_exponents],
    }


def report_text(report: Json, name: str) -> str:
    """The report as text."""
    unit = "rpm" if report["vehicle"] == "motor" else "rad/s and m/s^2"
    return render("report.txt", {"r": report, "name": name, "unit": unit})
