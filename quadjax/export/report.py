"""The report of a conversion, with proven bounds and measurements, as JSON and as text."""

import dataclasses
import hashlib

import jax.numpy as jnp
import numpy as np

from quadjax.core import mlp
from quadjax.export import emulator
from quadjax.export.battery_tables import BatteryTables, update_error
from quadjax.export.conversion import Converted
from quadjax.export.fixed import FixedNetwork
from quadjax.export.integers import WORD, enable_x64
from quadjax.export.render import render
from quadjax.export.words import VERSION
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


def uniform_samples(network: FixedNetwork, count: int, seed: int) -> np.ndarray:
    """Observations (count, inputs) float32, uniform in the declared ranges."""
    rng = np.random.default_rng(seed)
    shape = (count, network.inputs)
    return (rng.uniform(-1.0, 1.0, shape) * network.box.ranges).astype(np.float32)


def make_report(converted: Converted, file: str) -> Json:
    """The report as JSON takes it; the verification reads the options from it.

    Args:
        converted: the conversion.
        file: name of the policy file.
    """
    network, rollouts, laps = converted.network, converted.rollouts, converted.rollouts.laps
    assert laps is not None
    residual = converted.own.residual
    box, tables, unit = network.box, converted.fixed.estimator, 2.0**network.fraction_bits
    samples = {
        "random inputs": uniform_samples(network, BOX_SAMPLES, 0),
        "simulated": rollouts.observations,
    }
    return {
        "format_version": VERSION,
        "vehicle": network.model.name,
        "unit": network.unit,
        "inputs": [
            {"name": name, "range": float(limit), "unit": unit}
            for name, limit, unit in zip(box.layout.labels, box.ranges, box.units, strict=True)
        ],
        "fraction_bits": network.fraction_bits,
        "command_low": (network.command_low / unit).tolist(),
        "command_high": (network.command_high / unit).tolist(),
        "layers": [_layer(converted, index) for index in range(len(network.layers))],
        "error_bound": converted.proof.error_bound.tolist(),
        "measured_error": {name: _measure(converted, x) for name, x in samples.items()},
        "policy": file,
        "policy_sha256": converted.fixed.policy_hash,
        "source": converted.policy.source,
        "track": converted.own.track,
        "config": converted.own.origin,
        "config_sha256": hashlib.sha256(converted.own.config.encode()).hexdigest(),
        "deterministic": True,
        "options": dataclasses.asdict(converted.options),
        "estimator": tables
        and {
            "residual_sha256": residual and hashlib.sha256(residual.read_bytes()).hexdigest(),
            "channel_ranges": [2.0**e for e in tables.channel_exponents],
        },
        "battery": _battery(converted.fixed.battery),
        "flights": {
            "runs": len(laps.crashes),
            "finished": laps.finished,
            "laps": laps.lap_times.shape[1],
            "observations": rollouts.steps,
        },
    }


def _battery(tables: BatteryTables | None) -> Json | None:
    """Range and error of the estimate of the highest propeller speed."""
    if tables is None:
        return None
    return {
        "lowest_rpm": tables.lowest * tables.unit,
        "highest_rpm": tables.highest * tables.unit,
        "first_rpm": tables.first * tables.unit,
        "update_error_rpm": update_error(tables),
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


def _measure(converted: Converted, observations: np.ndarray) -> Json:
    """Errors of the fixed-point policy over observations (n, inputs), in the command's unit."""
    fixed = emulator.commands(converted.network, observations)
    error = np.abs(fixed - float64_commands(converted.policy, observations))
    return {
        "samples": len(observations),
        "largest": error.max(axis=0).tolist(),
        "median": float(np.median(error)),
    }


def report_text(report: Json, name: str) -> str:
    """The report as text."""
    return render("report.txt", {"r": report, "name": name, "unit": report["unit"]})
