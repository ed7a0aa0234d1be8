"""Made-up policies, and what the tests of the export package share."""

import dataclasses
import functools
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.resources import CONFIGS
from quadjax.export import flights, race_source
from quadjax.export.battery import make_battery
from quadjax.export.cases import make_cases
from quadjax.export.conversion import Options, convert_policy
from quadjax.export.convert import export_c
from quadjax.export.network import FixedNetwork, convert
from quadjax.export.race_source import OwnRace
from quadjax.export.race_tables import make_tables, state_sizes
from quadjax.export.ranges import track_ranges
from quadjax.export.states import observe
from quadjax.export.targets import TARGETS
from quadjax.export.verify.build import Library, Sources
from quadjax.export.words import FixedPolicy, pack
from quadjax.policy.file import Policy, layout_of_release_1
from quadjax.policy.race import race_of_policy
from quadjax.race.laps import Laps
from quadjax.race.observations import HIGHEST_RPM, fields_of
from quadjax.training.build import make_networks, policy_of
from quadjax.vehicle import motor
from quadjax.vehicle.residual import Residual, write_residual
from tests.frozen.c_code import LAYOUTS

DISTURBANCE = {"moment_x": 0.03, "moment_y": 0.03, "moment_z": 0.01, "force_z": 0.5}
WIDE = {"position": 32.0, "velocity": 64.0, "rates": 1024.0, "next_position": 8.0}


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
    field = dataclasses.replace(fields_of(motor.MODEL)[HIGHEST_RPM], span=((0.75 * top, top),))
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
                np.float32(g * rng.standard_normal((a, b))),
                np.float32(g * 0.1 * rng.standard_normal(b)),
            )
            for a, b, g in sizes
        )

    ends = [np.float32(x) for x in (3000.0, 11000.0, -1.0)]
    return Residual(network(7, 1, 0.1), network(10, 3, 0.002), *ends)


def own_race(policy, config=None, track=None):
    """The race of a policy, or of a config."""
    found, origin = race_of_policy(policy, config=config, track=track)
    return race_source.own_race(found, policy, origin)


TRACK = """\
gates:
  - {position: [2.0, -1.5, -1.5], yaw_deg: 45, size: [1.2, 0.8]}
  - {position: [2.0, 1.5, -1.5], yaw_deg: 135}
  - {position: [-2.0, -1.5, -1.5], yaw_deg: 315}
"""


def tree_of(config):
    """A config as policy files contain it."""
    return config.model_dump(mode="json", by_alias=True)


def export_of(folder: Path) -> Path:
    """A made-up policy exported; it does not finish its race, and its ranges are wide.

    It was trained in another race than the one of the export, which has a residual, a track of its
    own, the authors' gate test and a vehicle without some effects. It observes the highest
    propeller speed of a battery.
    """
    policy, out = folder / "policy.npz", folder / "c"
    trained = load_config("e2e +residual", ["battery.charge=[0.1, 1]"])
    own = with_highest_rpm(made_policy(24, gain=0.5))
    dataclasses.replace(own, config=tree_of(trained)).save(policy)
    write_residual(folder / "made_up.npz", made_residual(np.random.default_rng(0), 0.1), {})
    config, track = folder / "config.yaml", folder / "triangle.yaml"
    track.write_text(TRACK)
    config.write_text(
        f"base: {CONFIGS / 'e2e.yaml'}\nrules: {{gate_test: world_box}}\n"
        "battery: {charge: [0.1, 1]}\nvehicle:\n"
        f"  residual: {folder / 'made_up.npz'}\n  constants: {{k_h: 0.0, k_r2: 0.0}}\n"
    )
    allowed = {"allow_unfinished": True, "allow_other_race": True}
    export_c(policy, out, config, WIDE, "made", track=str(track), **allowed)
    for path in (config, track, folder / "made_up.npz", policy):
        path.unlink()  # the folder needs nothing from outside
    return out


def random_states(rng, count, own, low, high):
    """States that a race may meet, (n, state_size) float32; quaternions of length one."""
    parts = []
    for name, size in state_sizes(own.choices.layout, own.choices.model).items():
        spread = {"position": 6.0, "velocity": 3.0, "rates": 4.0}.get(name, 0.01)
        part = rng.uniform(-spread, spread, (count, size))
        if name == "quaternion":
            part = rng.normal(0, 1, (count, 4))
            part /= np.linalg.norm(part, axis=1, keepdims=True)
        if name == "euler":
            part = rng.uniform(-1, 1, (count, 3)) * [1.4, 1.4, 9.0]
        if name == "last_command":
            part = rng.uniform(low, high, (count, size))
        if name == "highest_rpm":
            part = rng.uniform(0.75, 1.0, (count, size)) * high.max()
        if name in ("rpm", "rotor_speed", "thrust"):
            part = rng.uniform(1.0, {"rpm": 11000, "rotor_speed": 3000}.get(name, 15), part.shape)
        parts.append(part)
    return np.concatenate(parts, axis=1).astype(np.float32)


def untrained(config: Config) -> Policy:
    """A policy with random weights for the race of a config, by NumPy alone."""
    rng = np.random.default_rng(config.seed)
    shapes = jax.eval_shape(make_networks(config).init, jax.random.key(0))

    def weights(x):
        scale = 1.0 / np.sqrt(x.shape[0]) if len(x.shape) == 2 else 0.0
        return np.float32(scale * rng.standard_normal(x.shape))

    return policy_of(config, jax.tree.map(weights, shapes), {})


def random_rollouts(own: OwnRace, velocity: float = 1.0) -> flights.Rollouts:
    """Rows in place of those of 32 flights, of which none finished a lap."""
    rng, count = np.random.default_rng(0), 50
    size = sum(state_sizes(own.choices.layout, own.choices.model).values())
    rows = rng.uniform(-0.2, 0.2, (count, own.choices.layout.size)).astype(np.float32)
    rows[0, own.choices.layout.slice("velocity")] = velocity
    states = rng.uniform(-0.2, 0.2, (count, size)).astype(np.float32)
    none = Laps(np.full((32, 6), np.nan), ("out of time",) * 32, np.full(32, 10.0), 10.0)
    targets = rng.integers(0, len(own.params.track.yaw), count).astype(np.int32)
    return flights.Rollouts(rows, states, targets, none, count)


def fixed_policy(policy, own, states=None, targets=None, battery=None, estimator=None, **changes):
    """A policy as integers; fields of its race's tables may be changed."""
    wide = {"position": 32.0} if "position" in policy.layout else {}
    network = convert(policy, track_ranges(policy.layout, own.params.track) | wide)
    race = make_tables(network.box, policy, own.choices, own.params)
    race = dataclasses.replace(race, **changes)
    if states is None:
        rng = np.random.default_rng(0)
        states = random_states(rng, 20, own, policy.command_low, policy.command_high)
        targets = rng.integers(0, race.gates, 20)
    if battery is None and HIGHEST_RPM in policy.layout:
        battery = make_battery(own.params.vehicle.constants, 10_000.0, 1.0 / own.time_step)
    tables = (network, race, estimator, battery)
    cases = make_cases(*tables, None, states, targets)
    return FixedPolicy("made", *tables, "ab" * 32, own.time_step, cases)


def library(fixed, folder, target="qjp"):
    """The C runtime of a target on this machine, with a policy loaded: its self-tests pass."""
    words = pack(fixed)
    folder.mkdir(parents=True, exist_ok=True)
    sources = Sources.write(TARGETS[target], None, folder, fixed)
    return Library(sources, fixed, words, folder)


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


SIZES = {  # of the observation
    "e2e with a history": 64,
    "racing, axes and more": 31,
    "e2e, axes and more": 36,
    "e2e with quaternions": 24,
    "indi and more": 29,
    "racing with a history": 67,
    "published racing": 20,
    "without rotors": 20,
}
WITHOUT = ("vehicle=5inch", "observation.actuators=false", "observation.last_action=true")
RACES = LAYOUTS | {"without rotors": ("e2e", WITHOUT)}  # preset, overrides


@functools.cache
def made(name):
    """An untrained policy of a race, and the race."""
    preset, overrides = RACES[name]
    config = load_config(preset, [*overrides, "network.hidden=[8]", "track.generate.seed=1"])
    policy = untrained(config)
    assert policy.layout.size == SIZES[name]
    layers = [(np.asarray(k) * 0.3, np.asarray(b) + 0.01) for k, b in policy.layers]
    return dataclasses.replace(policy, layers=tuple(layers)), race_source.own_race(
        config, policy, "test"
    )


def converted_in(folder, policy, own, target, rate=500.0, **more):
    """A policy converted, with its C in a folder, without the simulated flights of an export."""
    folder.mkdir(exist_ok=True)
    policy.save(folder / "policy.npz")
    rng = np.random.default_rng(0)
    states = random_states(rng, 20, own, policy.command_low, policy.command_high)
    targets = np.arange(20) % len(own.params.track.yaw)
    rows = flights.Rollouts(observe(own, states, targets), states, targets)
    options = Options("made", {"position": 32.0}, sample_rate=rate, target=target, **more)
    path = folder / "policy.npz"
    converted = convert_policy(policy, own, options, path.name, path, rows)
    for name, data in converted.files().items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return converted


@functools.cache
def fixed(name):
    """Race, policy as integers, and 200 states and targets."""
    policy, own = made(name)
    rng = np.random.default_rng(0)
    states = random_states(rng, 200, own, policy.command_low, policy.command_high)
    targets = rng.integers(0, len(own.params.track.yaw), 200)
    return own, fixed_policy(policy, own, states, targets), states, targets
