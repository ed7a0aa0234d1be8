"""What is proven and measured about an export, as JSON and as text."""

import dataclasses
import hashlib
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core import mlp
from quadjax.export import emulator
from quadjax.export.conversion import Converted
from quadjax.export.flights import Rollouts
from quadjax.export.integers import WORD
from quadjax.export.network import FixedNetwork
from quadjax.policy.file import Policy

BOX_SAMPLES = 20_000
Json = dict[str, Any]


def float64_commands(policy: Policy, observations: np.ndarray) -> np.ndarray:
    """Commands (n, 4) of the real-valued policy, in float64."""
    with jax.enable_x64(True):
        layers = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), policy.layers)
        inputs = jnp.asarray(observations, jnp.float64)
        y = np.asarray(mlp.apply(mlp.to_params(layers), inputs, "relu"))
    low, high = policy.command_low, policy.command_high
    return low + 0.5 * (high - low) * (np.clip(y, -1.0, 1.0) + 1.0)


def uniform_samples(network: FixedNetwork, count: int, seed: int) -> np.ndarray:
    """Observations (count, inputs) float32, uniform in the declared ranges."""
    shape = (count, network.inputs)
    uniform = np.random.default_rng(seed).uniform(-1.0, 1.0, shape)
    return (uniform * network.box.ranges).astype(np.float32)


def make_report(converted: Converted, rollouts: Rollouts) -> Json:
    """Proven bounds and measurements, as a JSON value; ``verify`` reads the options from it."""
    in_c, laps = converted.in_c, rollouts.laps
    network, box, race = in_c.network, in_c.network.box, converted.race
    unit = 2.0**network.fraction_bits
    inputs = zip(box.layout.labels, box.ranges.tolist(), box.units, strict=True)
    samples = {
        "random inputs": uniform_samples(network, BOX_SAMPLES, 0),
        "simulated": rollouts.observations,
    }
    report: Json = {
        "vehicle": network.model.name,
        "unit": network.unit,
        "inputs": [dict(zip(("name", "range", "unit"), row, strict=True)) for row in inputs],
        "fraction_bits": network.fraction_bits,
        "command_low": (network.command_low / unit).tolist(),
        "command_high": (network.command_high / unit).tolist(),
        "layers": [_layer(converted, index) for index in range(len(network.layers))],
        "error_bound": converted.proof.error_bound.tolist(),
        "measured_error": {name: _measure(converted, x) for name, x in samples.items()},
        "policy": converted.file,
        "policy_sha256": converted.policy_hash,
        "source": converted.policy.source,
        "track": race.track,
        "config": race.origin,
        "config_sha256": hashlib.sha256(race.text.encode()).hexdigest(),
        "options": dataclasses.asdict(converted.options),
        "estimators": in_c.sample_rate,
        "noise": None if in_c.noise is None else in_c.noise.tolist(),
        "flights": {
            "runs": len(laps.crashes),
            "finished": laps.finished,
            "laps": laps.lap_times.shape[1],
            "observations": sum(len(target) for _, target in rollouts.paths),
        },
    }
    return report


def _layer(converted: Converted, index: int) -> Json:
    """What is proven about a layer."""
    layers = converted.in_c.network.layers
    ranges, hidden = converted.proof.layers[index], index + 1 < len(layers)
    outputs = [max(0, high >> WORD) for high in ranges.high]
    return {
        "rows": len(outputs),
        "columns": int(layers[index].weights.shape[1]),
        "largest_accumulator": str(max(ranges.magnitude)),
        "accumulator_bits": round(converted.proof.accumulator_bits[index], 4),
        "largest_output": max(outputs) if hidden else None,
        "never_active": outputs.count(0) if hidden else None,
    }


def _measure(converted: Converted, observations: np.ndarray) -> Json:
    """Errors of the fixed-point policy over observations (n, inputs), in the command's unit."""
    fixed = emulator.commands(converted.in_c.network, observations)
    error = np.abs(fixed - float64_commands(converted.policy, observations))
    return {
        "samples": len(observations),
        "largest": error.max(axis=0).tolist(),
        "median": float(np.median(error)),
    }


def report_summary(report: Json, name: str) -> str:
    """The main numbers of a report, in three lines."""
    flown, error = report["flights"], max(report["error_bound"])
    measured = max(max(row["largest"]) for row in report["measured_error"].values())
    estimated = ", estimates on board are not part of them" * bool(report["estimators"])
    return "\n".join(
        (
            f"{name}: network in fixed point, no sum overflows for any input in its range",
            f"error against real arithmetic: at most {error:.2g} {report['unit']} (proven), "
            f"{measured:.2g} (measured)",
            f"{flown['finished']} of {flown['runs']} flights finish {flown['laps']} laps; "
            f"{flown['observations']} observations, none outside the ranges{estimated}",
        )
    )


def report_text(report: Json, name: str) -> str:
    """A report as text."""
    return "\n".join(_lines(report, name)) + "\n"


def _lines(r: Json, name: str) -> Iterator[str]:
    unit = f", {r['unit']}" if r["unit"] else ""
    yield f"{name}: policy in C\n"
    yield from (f"{key}: {r[key]}" for key in ("policy", "policy_sha256", "track", "config"))
    yield "\nInputs, and the range that every proof below holds for:"
    for i, row in enumerate(r["inputs"]):
        yield f"  {i:2d}  {row['name']:<17} +-{row['range']:g} {row['unit']}".rstrip()
    yield "\nProven for every input in those ranges, by intervals of exact integers:"
    yield "  layer   rows  columns  largest |sum|   of 2^63   largest output  never active"
    for i, row in enumerate(r["layers"]):
        share = 100 * int(row["largest_accumulator"]) / 2.0**63
        ends = ("-" if row[key] is None else row[key] for key in ("largest_output", "never_active"))
        sizes = f"  {i:5d}  {row['rows']:5d}  {row['columns']:7d}"
        yield f"{sizes}  2^{row['accumulator_bits']:<11.3f}  {share:6.2f}%  " + (
            "{:>15}  {:>12}".format(*ends)
        )
    yield f"\nError against real arithmetic{unit}:"
    yield f"  proven for every input      {_short(r['error_bound'])}"
    for key, row in r["measured_error"].items():
        yield f"  measured, {key:<17} {_short(row['largest'])} (of {row['samples']} samples)"
    yield ""
    if rate := r["estimators"]:
        yield f"Estimators on board at {rate:g} Hz"
    if noise := r["noise"]:
        yield f"Sampled: noise of standard deviation {_short(noise)} {r['unit']}".rstrip()
    limits = zip(r["command_low"], r["command_high"], strict=True)
    text = ", ".join(f"{low:g} .. {high:g}" for low, high in limits)
    yield f"Commands, for every input: {text}; {r['unit']}".rstrip("; ")
    flown = r["flights"]
    yield (
        f"Flights: {flown['finished']} of {flown['runs']} finished {flown['laps']} laps; "
        f"{flown['observations']} observations, none outside the ranges"
        + ", estimates on board are not part of them"
        * bool(r["estimators"])
    )


def _short(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
