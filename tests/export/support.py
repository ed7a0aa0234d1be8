"""Made-up policies of many races, as numbers and as C, for the tests of the exporter."""

import dataclasses
import functools
from pathlib import Path

import jax
import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.export import flights, race_source
from quadjax.export.conversion import Converted, Options, convert_policy
from quadjax.export.convert import export_c
from quadjax.export.library import Library
from quadjax.export.network import FixedNetwork
from quadjax.export.race_source import PolicyRace
from quadjax.export.states import state_sizes
from quadjax.policy.file import Policy
from quadjax.race.laps import Laps
from quadjax.race.observations import HIGHEST_RPM
from quadjax.training.build import first_params, make_policy
from quadjax.vehicle.residual import write_residual
from tests import reference as ref
from tests.convert import residual_of
from tests.frozen.c_code import LAYOUTS, MORE

WARNINGS = (
    "-Wall -Wextra -Wpedantic -Wconversion -Wshadow -Wcast-align -Werror "
    # Paparazzi's own set, and a little more
    "-Wunused -Wcast-qual -Wpointer-arith -Wmissing-prototypes -Wmissing-declarations "
    "-Wstrict-prototypes -Wnested-externs -Wredundant-decls -Wswitch-default -Wundef "
    "-Wwrite-strings -Wformat-security -Wvla -Wdouble-promotion -Wfloat-equal"
).split()
BATTERY = "battery.charge=[0.1, 1.0]"
RANDOM_TRACK = "track.generate.seed=1"
RACES = {  # preset, overrides
    "e2e": ("e2e +disturbance", ()),
    "indi": ("indi", ()),
    "battery": ("e2e", (BATTERY, "observation.disturbance=none")),
    "everything": ("e2e +disturbance", (*MORE, BATTERY)),
    "half turns": ("e2e_race", ("vehicle=5inch", "track=figure8_tudelft")),
}
RACES |= {name: (preset, (*more, RANDOM_TRACK)) for name, (preset, more) in LAYOUTS.items()}
WIDE = {"position": 64.0, "velocity": 128.0, "rates": 1024.0, "attitude": 4.0}
SPREADS = {"position": 6.0, "velocity": 3.0, "rates": 4.0, "euler": np.array([1.4, 1.4, 9.0])}
TOPS = {"rpm": 11_000.0, "rotor_speed": 3000.0, "thrust": 15.0}


def with_weights(policy: Policy, hidden: tuple[int, ...], gain: float) -> Policy:
    """The policy with random layers that react to all that it sees, and do not saturate."""
    rng, sizes = np.random.default_rng(0), (policy.layout.size, *hidden, 4)
    layers = [
        (gain * np.sqrt(2.0 / a) * rng.standard_normal((a, b)), 0.1 * rng.standard_normal(b))
        for a, b in zip(sizes[:-1], sizes[1:], strict=True)
    ]
    layers[-1] = (0.3 * layers[-1][0], layers[-1][1])
    return dataclasses.replace(
        policy, layers=tuple((np.float32(kernel), np.float32(bias)) for kernel, bias in layers)
    )


def config_of(name: str, *overrides: str) -> Config:
    """The config of one of ``RACES``."""
    preset, more = RACES[name]
    return load_config(preset, [*more, "network.hidden=[8]", *overrides])


@functools.cache
def made(name: str, hidden: tuple[int, ...] = (8,), gain: float = 0.5) -> tuple[Policy, PolicyRace]:
    """A made-up policy of one of ``RACES``, and its race."""
    config = config_of(name)
    shapes = jax.eval_shape(lambda: first_params(config, 0))
    zeros = jax.tree.map(lambda x: np.zeros(x.shape, np.float32), shapes)
    policy = with_weights(make_policy(config, zeros), hidden, gain)
    return policy, race_source.policy_race(config, policy, "test")


def random_states(policy: Policy, own: PolicyRace, count: int, seed: int = 0) -> np.ndarray:
    """States that a race may meet, (n, state_size) float32; quaternions of length one."""
    rng, parts = np.random.default_rng(seed), []
    low, high = policy.command_low, policy.command_high
    for name, size in state_sizes(own.environment.layout, own.environment.model).items():
        part = rng.uniform(-1.0, 1.0, (count, size)) * SPREADS.get(name, 0.01)
        if name == "quaternion":
            part = rng.normal(0, 1, (count, 4))
            part /= np.linalg.norm(part, axis=1, keepdims=True)
        elif name == "last_command":
            part = rng.uniform(low, high, (count, size))
        elif name == HIGHEST_RPM:
            part = rng.uniform(0.75, 1.0, (count, size)) * high.max()
        elif name in TOPS:
            part = rng.uniform(1.0, TOPS[name], (count, size))
        parts.append(part)
    return np.concatenate(parts, axis=1).astype(np.float32)


def random_targets(own: PolicyRace, count: int) -> np.ndarray:
    """Target gates (n,) of such states."""
    return np.random.default_rng(1).integers(0, len(own.params.track.yaw), count)


def random_rollouts(own: PolicyRace, velocity: float = 1.0) -> flights.Rollouts:
    """Rows in place of those of 32 flights, of which none finished a lap."""
    rng, count = np.random.default_rng(0), 50
    size = sum(state_sizes(own.environment.layout, own.environment.model).values())
    rows = rng.uniform(-0.2, 0.2, (count, own.environment.layout.size)).astype(np.float32)
    rows[0, own.environment.layout.slice("velocity")] = velocity
    states = rng.uniform(-0.2, 0.2, (count, size)).astype(np.float32)
    none = Laps(np.full((32, 6), np.nan), ("out of time",) * 32, np.full(32, 10.0), 10.0)
    targets = random_targets(own, count).astype(np.int32)
    path = np.zeros((2, 3), np.float32), np.zeros(2, np.int32)
    return flights.Rollouts(rows, states, targets, none, [path])


def convert(policy: Policy, own: PolicyRace, folder: Path, target="cortex-m7", **more) -> Converted:
    """A policy as C, without the simulated flights of an export; its file is in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "policy.npz"
    policy.save(path)
    ranges = {"position": 32.0} if "position" in policy.layout else {}
    options = Options("made", ranges, target=target, **more)
    return convert_policy(policy, own, options, path.name, path)


def converted(
    name: str, folder: Path, hidden: tuple[int, ...] = (8,), gain=0.5, **more
) -> Converted:
    """A made-up policy of one of ``RACES`` as C; ``everything`` has a residual, too."""
    policy, own = made(name, hidden, gain)
    if name == "everything":
        residual = residual_of(ref.random_residual(-1.0))
        vehicle = own.params.vehicle.replace(residual=residual)
        own = dataclasses.replace(own, params=own.params.replace(vehicle=vehicle))
    return convert(policy, own, folder, **more)


def library(of: Converted, folder: Path, *options: str) -> Library:
    """The C of a policy on this machine."""
    folder.mkdir(parents=True, exist_ok=True)
    return Library(of, folder, options)


def export_of(folder: Path) -> Path:
    """A made-up policy with everything, exported for another race than that of its training.

    That race has a residual, another track, the authors' gate test and a vehicle without some
    effects. The policy does not finish it, and its ranges are wide.
    """
    policy, _ = made("everything", (24, 24), 0.25)
    residual, out = folder / "made_up.npz", folder / "c"
    values = ref.random_residual(-1.0)
    write_residual(residual, residual_of(values), {})
    other = ("rules.gate_test=world_box", "track=figure8", f"vehicle.residual={residual}")
    effects = ("vehicle.constants.k_h=0", "vehicle.constants.k_r2=0")
    config = config_of("everything", *other, *effects)
    allowed = {"allow_unfinished": True, "allow_other_race": True}
    export_c(policy, out, config, WIDE | {"next_position": 16.0}, "made", **allowed)
    residual.unlink()  # the folder needs nothing from outside
    return out


def observations(network: FixedNetwork, count: int) -> np.ndarray:
    """Observations of all sizes, some outside the box, some not numbers, float32."""
    rng = np.random.default_rng(0)
    size = rng.choice([0.01, 0.3, 1.0, 3.0], (count, 1))
    x = rng.uniform(-1.0, 1.0, (count, network.inputs)) * network.box.ranges * size
    bad = np.array([np.nan, np.inf, -np.inf, 1e-42, 3e38])
    rows = rng.integers(0, count, len(bad) * 4)
    x[rows, rng.integers(0, network.inputs, len(rows))] = np.tile(bad, 4)
    return x.astype(np.float32)
