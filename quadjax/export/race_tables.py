"""The observation in fixed point: a track and the scales of a vehicle's state as integers.

Every number of the state becomes an integer of 2^-30 of its own range, a power of two; the rest is
sums and products of integers. Positions and velocities are rotated into the gate's frame by a
cosine and a sine in Q30, a yaw is wrapped by one multiplication, and what is scaled to [-1, 1] is
``(q - middle) factor >> shift``. The state is that of the vehicle model, field by field, and the
inputs are those of the policy's layout, in its order.
"""

import dataclasses
import itertools
import math
from typing import Literal

import jax.numpy as jnp
import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.frames import world_to_body
from quadjax.core.vectors import Vec3
from quadjax.export.integers import ONE, Rescale
from quadjax.export.ranges import InputBox, next_gates
from quadjax.policy.file import Policy
from quadjax.race.environment import Race
from quadjax.race.layout import LAST_ACTION, Layout, ObservedField
from quadjax.race.observation_config import NONE
from quadjax.race.observations import DISTURBANCES, HIGHEST_RPM
from quadjax.race.track import Track
from quadjax.race.types import RaceParams
from quadjax.vehicle.battery import LOWEST
from quadjax.vehicle.protocol import VehicleModel

YAW_EXPONENT = 6  # of the state's yaw: +-64 rad, because an autopilot may not wrap it
WIND_EXPONENT = 2  # the state's velocity has four times the range of the network's input
TURN_BITS = 56  # one turn is 2^56 of (yaw * TURNS_PER_UNIT)
TURNS_PER_UNIT = round(2.0**32 / (2.0 * math.pi))  # turns of a yaw in Q24 are its product in Q56
TWO_PI = round(2.0 * math.pi * ONE)  # Q30
UNOBSERVED = 20  # exponent of numbers of the state that no input needs
FARTHEST = 15  # exponent of the largest distance of a gate
LARGEST_SPAN = 1e6
# How the C computes a field: from numbers of the state, or from the gate alone.
Kind = Literal["position", "velocity", "attitude", "rotation", "copy", "scaled", "gate"]
# Field of the observation: how it is computed, and from which field of the state.
KINDS: dict[str, tuple[Kind, str]] = {
    "position": ("position", "position"),
    "velocity": ("velocity", "velocity"),
    "attitude": ("attitude", "euler"),
    "rotation": ("rotation", "quaternion"),
    "rates": ("copy", "rates"),
}
VECTORS = {kind: source for kind, source in KINDS.values() if kind != "copy"}  # of the state
TRACK = np.dtype([  # of a gate, int64; positions and sizes in the state's position units
    ("position", "<i8", 3),
    ("axes", "<i8", 9),  # Q30: directions through, to the right and down
    *((name, "<i8") for name in ("cosine", "sine", "half_width", "half_height")),  # Q30 of the yaw
    ("round", "<i8"),  # 1: a circle
    ("yaw", "<i8"),  # rad, Q30
])  # fmt: skip
NUMBER = np.dtype([(name, "<i4") for name in ("source", "middle", "factor", "shift")])
PLAIN = Rescale(0, 0, 1)  # of an input that is not scaled, or that the policy sees as zero
LAST_COMMAND = "last_command"  # field of the state that the field LAST_ACTION is scaled from
QUATERNION_EXPONENT = 1  # +-2: a component of length one may be rounded up
FIELDS = {  # of the state: its size, unit and frame
    "position": (3, "m, world"),
    "velocity": (3, "m/s, world"),
    "euler": (3, "roll, pitch, yaw, rad; any yaw, wrapped here"),
    "quaternion": (4, "w, x, y, z: body to world, of length one"),
    "rates": (3, "p, q, r, rad/s, body"),
    "rotor_speed": (4, "1 front-left, 2 front-right, 3 rear-right, 4 rear-left; rad/s"),
    LAST_COMMAND: (4, "command of the step before; at the start halfway between the limits"),
    "thrust": (1, "specific thrust along body -z, m/s^2"),
    "rpm": (4, "1 front-left, 2 front-right, 3 rear-right, 4 rear-left"),
    "moment_ext": (3, "external moment, N m, body"),
    "force_ext": (3, "external specific force, m/s^2, body"),
    HIGHEST_RPM: (1, "that the battery permits, rpm: of the battery's update"),
}


@dataclasses.dataclass(frozen=True)
class Input:
    """A field of the observation: the inputs from ``index`` on."""

    name: str
    kind: Kind
    index: int
    # (size,) of ``NUMBER``: number of the state, or of the gate's constants; of a rotation the
    # first one. Scaled inputs are (number - middle) factor >> shift, others have 0, 0 and 1.
    numbers: np.ndarray

    @property
    def sources(self) -> np.ndarray:
        """The numbers that it is computed from."""
        sources = self.numbers["source"]
        return sources[0] + np.arange(4) if self.kind == "rotation" else sources


@dataclasses.dataclass(frozen=True)
class RaceTables:
    """Integers of the observation and of the gate logic."""

    box: InputBox  # of the network's inputs
    fields: dict[str, tuple[int, ...]]  # of the state: exponents of the ranges of its numbers
    inputs: tuple[Input, ...]
    track: np.ndarray  # (gates,) of ``TRACK``
    next_gate: np.ndarray  # (gates, n) int64, network inputs that depend on the gate alone
    world_box: bool  # a gate's opening is tested along the world's axes, not its own
    time_step: float  # s, between observations

    @property
    def gates(self) -> int:
        """Number of gates."""
        return len(self.track)

    @property
    def exponents(self) -> tuple[int, ...]:
        """Exponent of the range of every number of the state."""
        return tuple(itertools.chain(*self.fields.values()))

    @property
    def starts(self) -> dict[str, int]:
        """Index of the first number of each field of the state."""
        ends = itertools.accumulate(len(exponents) for exponents in self.fields.values())
        return dict(zip(self.fields, (0, *ends), strict=False))

    @property
    def state_size(self) -> int:
        """Number of floats in the state."""
        return len(self.exponents)


def state_sizes(layout: Layout, model: VehicleModel) -> dict[str, int]:
    """The fields of the emitted state and their sizes, in order.

    A policy that observes a rotation matrix gets a quaternion, any other one Euler angles.
    """
    names = ["position", "velocity"]
    names += [] if "rotation" in layout and "attitude" not in layout else ["euler"]
    names += ["quaternion"] if "rotation" in layout else []
    names += ["rates", model.actuators.name]
    names += ["moment_ext", "force_ext"] if model.disturbed else []
    names += [HIGHEST_RPM] if HIGHEST_RPM in layout else []
    names += [LAST_COMMAND] if LAST_ACTION in layout else []
    size = model.actuators.size  # of actuators that no C has
    return {name: FIELDS.get(name, (size,))[0] for name in names}


def make_tables(box: InputBox, policy: Policy, environment: Race, params: RaceParams) -> RaceTables:
    """The integers of a policy's observation on a track, scaled to the box of the network's inputs.

    Raises:
        InputError: a gate that is farther away than 2^15 m, or a next gate outside the box.
    """
    track = params.track
    position = np.stack([np.asarray(c, np.float64) for c in track.position.components()], axis=1)
    reach = float(np.abs(position).max()) + box.limit("position")
    world = max(5, math.ceil(math.log2(reach)))
    if world > FARTHEST:
        raise InputError(f"a gate lies {reach:.3g} m away, allowed: 2^{FARTHEST} m")
    yaw, unit = np.asarray(track.yaw, np.float64), ONE / 2.0**world
    numbers = {
        "position": position * unit,
        "cosine": np.cos(yaw) * ONE,
        "sine": np.sin(yaw) * ONE,
        "half_width": np.asarray(track.half_width, np.float64) * unit,
        "half_height": np.asarray(track.half_height, np.float64) * unit,
        "round": 0 if track.circle is None else np.asarray(track.circle),
        "yaw": yaw * ONE,
    }
    gates = np.zeros(len(yaw), TRACK)
    for name, values in numbers.items():
        gates[name] = np.rint(values).astype(np.int64)
    gates["axes"] = _gate_axes(track, gates["cosine"], gates["sine"]).reshape(-1, 9)
    spans = _spans(policy, box)
    tables = RaceTables(
        box=box,
        fields=_state_fields(box, environment.model, world, spans),
        inputs=(),
        track=gates,
        next_gate=_gate_constants(box, track),
        world_box=params.rules.gate_test == "world_box",
        time_step=float(params.rules.time_step),
    )
    return dataclasses.replace(tables, inputs=_inputs(tables, spans))


def _gate_axes(track: Track, cosine: np.ndarray, sine: np.ndarray) -> np.ndarray:
    """Each gate's axes (gates, 3, 3) in the world, Q30, of the yaw alone or of its attitude."""
    if track.attitude is None:
        zero, one = np.zeros_like(cosine), np.full_like(cosine, ONE)
        rows = (cosine, sine, zero, -sine, cosine, zero, zero, zero, one)
        return np.stack(rows, axis=1)
    axes = []
    for axis in np.eye(3):
        seen = world_to_body(track.attitude, Vec3(*jnp.float32(axis)))
        axes.append(np.stack([np.asarray(x, np.float64) for x in seen.components()], axis=1))
    return np.rint(np.stack(axes, axis=2) * ONE).astype(np.int64)


Spans = list[tuple[int, Rescale | None]]  # of each number: exponent of the state's, and integers


def _spans(policy: Policy, box: InputBox) -> dict[str, Spans]:
    """Exponents and integers of the scaled fields."""
    return {
        field.name: [_span(policy, box, field, number) for number in range(field.size)]
        for field in policy.layout.fields
        if field.name in box.scaled_fields
    }


def _span(
    policy: Policy, box: InputBox, field: ObservedField, number: int
) -> tuple[int, Rescale | None]:
    """[low, high] to [-1, 1]: the exponent of the state's number, and the integers.

    The integers of a disturbance are None where the policy sees zero.
    """
    network, top = box.exponent[field.name], float(policy.command_high[0])
    start, limit = f"the policy's layout: {field.name} has a span of", LARGEST_SPAN
    if field.name in DISTURBANCES:
        half = field.span[number][1] if field.span else 0.0
        if not 0 <= half < limit:
            raise InputError(f"{start} {half:g}, allowed: 0..1e6")
        if field.source == NONE or half == 0:
            return 0, None
        exponent = math.ceil(math.log2(half * 2.0**network))
        return exponent, Rescale.of(0.0, 2.0 ** (exponent - network) / half)
    low, high = (
        field.span[number]
        if field.span
        else (LOWEST * top, top)
        if field.name == HIGHEST_RPM
        else tuple(
            float(end[number - field.size]) for end in (policy.command_low, policy.command_high)
        )
    )
    if low == high:
        raise InputError(f"{start} {[low, high]}, allowed: a width above zero")
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    reach = max(abs(middle + s * half * 2.0**network) for s in (-1, 1))
    exponent = math.ceil(math.log2(reach))
    unit = ONE / 2.0**exponent
    return exponent, Rescale.of(middle * unit, 2.0 / (high - low) * 2.0 ** (exponent - network))


def _gate_constants(box: InputBox, track: Track) -> np.ndarray:
    """The inputs that depend only on the gate, (gates, n) in the order of the layout."""
    values, columns = next_gates(track), [np.zeros((len(track.yaw), 0), np.int64)]
    for name in [name for name in box.layout.names if name in values]:
        numbers, limit = values[name], box.limit(name)
        for gate, column in np.argwhere(np.abs(numbers) > limit):
            raise InputError(
                f"gate {gate}: {name} is {numbers[gate, column]:.4g}, declared +-{limit:g}; "
                f"declare more with --range {name}={2 * limit:g}"
            )
        columns.append(np.trunc(numbers * (ONE / limit)).astype(np.int64))
    return np.concatenate(columns, axis=1)


def _state_fields(
    box: InputBox, model: VehicleModel, world: int, spans: dict[str, Spans]
) -> dict[str, tuple[int, ...]]:
    """The fields of the state, with the ranges that the inputs computed from them need."""
    attitude = box.exponent["attitude"]
    exponents = {
        "position": [world],
        "velocity": [box.exponent["velocity"] + WIND_EXPONENT],
        "euler": [attitude, attitude, YAW_EXPONENT],
        "quaternion": [QUATERNION_EXPONENT],
        "rates": [box.exponent["rates"]],
    } | {name: [exponent for exponent, _ in span] for name, span in spans.items()}
    exponents[LAST_COMMAND] = exponents.get(LAST_ACTION, [])
    fields = {}
    for name, size in state_sizes(box.layout, model).items():
        numbers = exponents.get(name) or [UNOBSERVED]
        fields[name] = tuple((numbers * size)[:size])  # of a force, only one number may be observed
    return fields


def _inputs(race: RaceTables, spans: dict[str, Spans]) -> tuple[Input, ...]:
    """How each field of the layout is computed."""
    layout, starts, inputs, constants = race.box.layout, race.starts, list[Input](), 0
    for field in layout.fields:
        name, index = field.name, layout.slice(field.name).start
        if name in KINDS:
            kind, source = KINDS[name]
            step = 0 if kind == "rotation" else 1
            sources = [starts[source] + step * i for i in range(field.size)]
        elif name in spans:
            axes = ["xyz".index(disturbance[-1]) for disturbance in DISTURBANCES.get(name, ())]
            first = starts[LAST_COMMAND if name == LAST_ACTION else name]
            kind, sources = "scaled", [first + i for i in axes or range(field.size)]
        else:
            kind, sources = "gate", list(range(constants, constants + field.size))
            constants += field.size
        rescales = [rescale or PLAIN for _, rescale in spans.get(name, [(0, None)] * field.size)]
        rows = [(at, *dataclasses.astuple(x)) for at, x in zip(sources, rescales, strict=True)]
        inputs.append(Input(name, kind, index, np.array(rows, NUMBER)))
    return tuple(inputs)
