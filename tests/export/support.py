"""Made-up policies, and what the tests of the export package share."""

import dataclasses
import shutil
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.export.emit import Provenance, emit_network
from quadjax.export.fixed import FixedNetwork, convert
from quadjax.policy.file import Policy
from quadjax.policy.release1 import layout_of_release_1
from quadjax.race.layout import ESTIMATED, highest_command
from quadjax.vehicle.residual import Residual

DISTURBANCE = {"moment_x": 0.03, "moment_y": 0.03, "moment_z": 0.01, "force_z": 0.5}
WIDE = {"position": 32.0, "velocity": 64.0, "rates": 1024.0, "next_position": 8.0}
ORIGIN = Provenance("made", "00" * 32, ("Policy   made up",), "tests")


def made_policy(
    width: int = 16,
    vehicle: str = "motor",
    seed: int = 0,
    depth: int = 3,
    gain: float = 1.0,
    activation: str = "relu",
    hidden: tuple[int, ...] | None = None,
) -> Policy:
    """A random policy that reacts to all that it sees; ``hidden`` instead of width and depth."""
    rng = np.random.default_rng(seed)
    sizes = [24 if vehicle == "motor" else 17, *(hidden or [width] * depth), 4]
    layers = []
    for a, b in zip(sizes[:-1], sizes[1:], strict=True):
        kernel = gain * rng.standard_normal((a, b)) * np.sqrt(2.0 / a)
        layers.append(
            (kernel.astype(np.float32), (0.1 * rng.standard_normal(b)).astype(np.float32))
        )
    layers[-1] = (np.float32(0.3) * layers[-1][0], layers[-1][1])
    motor = vehicle == "motor"
    low = np.full(4, 3000.0) if motor else np.array([-3.0, -3.0, -3.0, 0.0])
    high = np.full(4, 11000.0) if motor else np.array([3.0, 3.0, 3.0, 15.0])
    seen = {"disturbance": DISTURBANCE} if motor else {}
    return Policy(
        layers=tuple(layers),
        log_std=np.zeros(4, np.float32),
        vehicle=vehicle,
        activation=activation,
        command_low=low,
        command_high=high,
        layout=layout_of_release_1("made up", {"vehicle": vehicle, "observation": seen}, low, high),
        source={"config": "e2e_shac" if motor else "indi_shac"},
    )


def with_highest_rpm(policy: Policy) -> Policy:
    """The policy, observing also the highest propeller speed."""
    top = float(policy.command_high[0])
    field = dataclasses.replace(highest_command(ESTIMATED), span=((0.75 * top, top),))
    layout = dataclasses.replace(policy.layout, fields=(*policy.layout.fields, field))
    (kernel, bias), *others = policy.layers
    more = np.concatenate([kernel, -2.0 * kernel[:1]])
    return dataclasses.replace(policy, layout=layout, layers=((more, bias), *others))


def made_residual(rng: np.random.Generator, gain: float = 1.0) -> Residual:
    """Random residual networks, of both signs."""

    def network(inputs: int, outputs: int, last: float) -> tuple:
        sizes = [(inputs, 32, 0.3), (32, outputs, gain * last)]
        return tuple(
            (
                jnp.asarray(g * rng.standard_normal((a, b)), jnp.float32),
                jnp.asarray(g * 0.1 * rng.standard_normal(b), jnp.float32),
            )
            for a, b, g in sizes
        )

    ends = [jnp.float32(x) for x in (3000.0, 11000.0, -1.0)]
    return Residual(network(7, 1, 0.1), network(10, 3, 0.002), *ends)


def observations(network: FixedNetwork, count: int, seed: int = 0) -> np.ndarray:
    """Observations of all sizes, some outside the box, some not numbers, float32."""
    rng = np.random.default_rng(seed)
    size = rng.choice([0.01, 0.3, 1.0, 3.0], (count, 1))
    x = (rng.uniform(-1.0, 1.0, (count, network.inputs)) * network.box.ranges * size).astype(
        np.float32
    )
    bad = np.array([np.nan, np.inf, -np.inf, 1e-42, 3e38], np.float32)
    rows = rng.integers(0, count, len(bad) * 4)
    x[rows, rng.integers(0, network.inputs, len(rows))] = np.tile(bad, 4)
    return x


def need(program: str) -> str:
    """Skip unless a program is on the path."""
    found = shutil.which(program)
    if found is None:
        pytest.skip(f"no {program} on this machine")
    return found


def write_network(network: FixedNetwork, folder: Path) -> Path:
    """The emitted network in a folder; returns its source."""
    for name, text in emit_network(network, ORIGIN, None).items():
        (folder / name).write_text(text)
    return folder / "made.c"


POLICIES = {
    "motor 64": {"width": 64},
    "rate": {"vehicle": "rate"},
    "narrow": {"width": 5, "depth": 1},
    "linear": {"depth": 0},
    "mixed": {"hidden": (96, 96, 48)},
    "odd": {"hidden": (33, 7, 18)},
    "wide": {"width": 300, "depth": 2, "vehicle": "rate"},
}


def named_network(name: str) -> tuple[Policy, FixedNetwork]:
    """One of ``POLICIES``, converted."""
    policy = made_policy(**POLICIES[name])
    return policy, convert(policy)
