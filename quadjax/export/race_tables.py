"""The observation in fixed point: a track and the scales of a vehicle's state as integers.

Every number of the state becomes an integer of 2^-30 of its own range, a power of two; the rest is
sums and products of integers. Positions and velocities are rotated into the gate's frame by a
cosine and a sine in Q30, a yaw is wrapped by one multiplication, and what is scaled to [-1, 1] is
``(q - middle) factor >> shift``. The state is that of the vehicle model, field by field, and the
inputs are those of the policy's layout, in its order.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core import quaternion
from quadjax.core.errors import InputError
from quadjax.core.frames import world_to_body
from quadjax.core.quaternion import Quaternion
from quadjax.core.vectors import Vec3
from quadjax.export.integers import ONE
from quadjax.export.ranges import InputBox, next_power
from quadjax.export.scaling import Rescale, Spans, spans_of
from quadjax.policy.file import Policy
from quadjax.race import episode
from quadjax.race.environment import Choices, RaceParams
from quadjax.race.layout import LAST_ACTION, Layout, split_name
from quadjax.race.observations import DISTURBANCES, HIGHEST_RPM, NEXT_FIELDS
from quadjax.race.track import Track, gates_ahead
from quadjax.vehicle.protocol import State, VehicleModel

YAW_EXPONENT = 6  # of the state's yaw: +-64 rad, because an autopilot may not wrap it
WIND_EXPONENT = 2  # the state's velocity has four times the range of the network's input
TURN_BITS = 56  # one turn is 2^56 of (yaw * TURNS_PER_UNIT)
TURNS_PER_UNIT = round(2.0**32 / (2.0 * math.pi))  # turns of a yaw in Q24 are its product in Q56
TWO_PI = round(2.0 * math.pi * ONE)  # Q30
UNOBSERVED = 20  # exponent of numbers of the state that no input needs
FARTHEST = 15  # exponent of the largest distance of a gate
# How the C computes a field: from numbers of the state, or from the gate alone.
POSITION, VELOCITY, ATTITUDE, ROTATION, COPY, SCALED, GATE = (
    *("position", "velocity", "attitude", "rotation", "copy", "scaled", "gate"),
)
KINDS = {  # field of the observation: how it is computed, and from which field of the state
    "position": (POSITION, "position"),
    "velocity": (VELOCITY, "velocity"),
    "attitude": (ATTITUDE, "euler"),
    "rotation": (ROTATION, "quaternion"),
    "rates": (COPY, "rates"),
}
LAST_COMMAND = "last_command"  # field of the state that the field LAST_ACTION is scaled from
QUATERNION_EXPONENT = 1  # +-2: a component of length one may be rounded up
NOTES = {  # unit and frame of a field of the state, for the header
    "position": "m, world",
    "velocity": "m/s, world",
    "euler": "roll, pitch, yaw, rad; any yaw, wrapped here",
    "quaternion": "w, x, y, z: body to world, of length one",
    "rates": "p, q, r, rad/s, body",
    "rotor_speed": "1 front-left, 2 front-right, 3 rear-right, 4 rear-left; rad/s",
    LAST_COMMAND: "command of the step before; at the start halfway between the limits",
    "thrust": "specific thrust along body -z, m/s^2",
    "rpm": "1 front-left, 2 front-right, 3 rear-right, 4 rear-left",
    "moment_ext": "external moment, N m, body",
    "force_ext": "external specific force, m/s^2, body",
    HIGHEST_RPM: "that the battery permits, rpm: of the battery's update",
}


@dataclasses.dataclass(frozen=True)
class StateField:
    """Numbers of the state that belong together."""

    name: str
    note: str
    start: int  # index of the first number
    exponents: tuple[int, ...]  # of each number's range

    @property
    def names(self) -> list[str]:
        """``position[0]`` and so on; the field's own name if it is a single number."""
        if len(self.exponents) == 1:
            return [self.name]
        return [f"{self.name}[{i}]" for i in range(len(self.exponents))]

    @property
    def ranges_text(self) -> str:
        """The declared ranges, for the header; a single one where all are the same."""
        shown = self.exponents[:1] if len(set(self.exponents)) == 1 else self.exponents
        return ", ".join(f"+-{2.0**e:g}" for e in shown)


@dataclasses.dataclass(frozen=True)
class Input:
    """A field of the observation: the inputs from ``index`` on."""

    name: str
    kind: str
    index: int
    sources: tuple[int, ...]  # numbers of the state, or of the gate's constants
    rescales: tuple[Rescale | None, ...] = ()  # of scaled inputs; None: the policy sees zero
    lag: int = 0  # steps before the present one, of the state that it is computed from


@dataclasses.dataclass(frozen=True)
class RaceTables:
    """Integers of the observation and of the gate logic."""

    box: InputBox  # of the network's inputs
    fields: tuple[StateField, ...]
    inputs: tuple[Input, ...]
    gate_position: np.ndarray  # (gates, 3) int64, in the state's position units
    gate_cos: np.ndarray  # (gates,) int64 Q30
    gate_sin: np.ndarray  # (gates,) int64 Q30
    gate_yaw: np.ndarray  # (gates,) int64, rad in Q30
    half_size: np.ndarray  # (gates, 2) int64 half width and height, in position units
    next_gate: np.ndarray  # (gates, n) int64, network inputs that depend on the gate alone
    world_box: bool  # a gate's opening is tested along the world's axes, not its own
    # (gates, 3, 3) int64 Q30: directions through, to the right and down; None: all upright
    axes: np.ndarray | None = None
    circle: np.ndarray | None = None  # (gates,) bool, round openings; None: all rectangles
    time_step: float = 0.0  # s, between observations; 0 where it is not known

    @property
    def history(self) -> int:
        """The number of earlier states that the observation needs."""
        return max(part.lag for part in self.inputs)

    @property
    def gates(self) -> int:
        """Number of gates."""
        return len(self.gate_yaw)

    @property
    def names(self) -> list[str]:
        """The state's numbers in order."""
        return [name for field in self.fields for name in field.names]

    @property
    def exponents(self) -> tuple[int, ...]:
        """Exponent of the range of every number of the state."""
        return tuple(e for field in self.fields for e in field.exponents)

    @property
    def state_size(self) -> int:
        """Number of floats in the state."""
        return len(self.exponents)

    @property
    def helpers(self) -> set[str]:
        """Names of the C functions that these inputs need, and ``gate`` if they need the gate."""
        kinds = {x.kind for x in self.inputs if x.kind != SCALED or any(x.rescales)}
        rotated = kinds & {POSITION, VELOCITY, ROTATION}
        own_axes = set() if self.world_box else {"own axes"}
        needed = {
            "along": rotated | ({"plane"} if self.axes is None else set()),
            "across": rotated | (own_axes if self.axes is None else set()),
            "round_shift": kinds - {COPY, GATE} | own_axes,
            "hold": kinds - {COPY, GATE},
            "wrap": kinds & {ATTITUDE},
            "matrix": kinds & {ROTATION},
            "rescale": kinds & {SCALED},
            "gate": kinds - {COPY, SCALED},
        }
        return {name for name, reasons in needed.items() if reasons}

    def exponent(self, field: str) -> int:
        """Exponent of the range of the first number of a field of the state."""
        return next(f.exponents[0] for f in self.fields if f.name == field)


def state_sizes(layout: Layout, model: VehicleModel) -> dict[str, int]:
    """The fields of the emitted state and their sizes, in order.

    A policy that observes a rotation matrix gets a quaternion, any other one Euler angles.
    """
    observed = [split_name(name)[0] for name in layout.names]
    angles = {} if "rotation" in layout and "attitude" not in layout else {"euler": 3}
    matrix = {"quaternion": 4} if "rotation" in layout else {}
    disturbances = {"moment_ext": 3, "force_ext": 3} if model.disturbed else {}
    limit = {HIGHEST_RPM: 1} if HIGHEST_RPM in layout else {}
    last = {LAST_COMMAND: model.action_size} if LAST_ACTION in observed else {}
    motion = {"position": 3, "velocity": 3, **angles, **matrix, "rates": 3}
    return {**motion, model.actuators.name: model.actuators.size, **disturbances, **limit, **last}


def drone_of(layout: Layout, model: VehicleModel, example: State, numbers: jax.Array) -> State:
    """A vehicle's state of the numbers (n,) of an emitted one; ``example`` has its structure."""
    values, start = {}, 0
    for name, size in state_sizes(layout, model).items():
        values[name] = [numbers[start + i] for i in range(size)]
        start += size
    leaves = []
    for field in dataclasses.fields(example):
        if getattr(example, field.name) is None:
            continue
        own = values.get(field.name, values[model.actuators.name])
        if field.name == "euler":
            own = _attitude(values, isinstance(example.euler, Quaternion))
        leaves += own
    return jax.tree.unflatten(jax.tree.structure(example), leaves)


def _attitude(values: dict[str, list[jax.Array]], as_quaternion: bool) -> list[jax.Array]:
    """The attitude of a state's numbers: three angles, or a quaternion."""
    if as_quaternion and "quaternion" not in values:
        return jax.tree.leaves(quaternion.of_euler(Vec3(*values["euler"])))
    if not as_quaternion and "euler" not in values:
        # Close to a pitch of 90 deg the arcsine magnifies a rounding error of the length.
        own = quaternion.normalized(Quaternion(*values["quaternion"]))
        return jax.tree.leaves(quaternion.to_euler(own, jnp.arctan2))
    return values["quaternion" if as_quaternion else "euler"]


def example_state(choices: Choices, params: RaceParams) -> State:
    """A vehicle's state as shapes."""
    return jax.eval_shape(functools.partial(episode.hover_start, choices), params).drone


def make_tables(box: InputBox, policy: Policy, choices: Choices, params: RaceParams) -> RaceTables:
    """The integers of a policy's observation on a track.

    Args:
        box: of the network's inputs, which the observation is scaled to.
        policy: whose limits and scaling it has.
        choices: whose vehicle model it has.
        params: whose track and gate test it has.

    Raises:
        InputError: a gate that is farther away than 2^15 m, or a next gate outside the network's
            box.
    """
    track = params.track
    position = np.stack([np.asarray(c, np.float64) for c in track.position.components()], axis=1)
    reach = float(np.abs(position).max()) + box.limit("position")
    world = max(5, math.ceil(math.log2(reach)))
    if world > FARTHEST:
        raise InputError(f"a gate lies {reach:.3g} m away, allowed: 2^{FARTHEST} m")
    yaw = np.asarray(track.yaw, np.float64)
    half = np.stack([np.asarray(track.half_width), np.asarray(track.half_height)], axis=1)
    unit = ONE / 2.0**world
    spans = _spans(policy, box)
    fields = _state_fields(box, choices.model, world, spans)
    return RaceTables(
        box=box,
        fields=fields,
        inputs=_inputs(box, fields, spans),
        gate_position=np.rint(position * unit).astype(np.int64),
        gate_cos=np.rint(np.cos(yaw) * ONE).astype(np.int64),
        gate_sin=np.rint(np.sin(yaw) * ONE).astype(np.int64),
        gate_yaw=np.rint(yaw * ONE).astype(np.int64),
        half_size=np.rint(half.astype(np.float64) * unit).astype(np.int64),
        next_gate=_gate_constants(box, track),
        world_box=params.rules.gate_test == "world_box",
        axes=_gate_axes(track),
        time_step=float(params.rules.time_step),
        circle=None if track.circle is None else np.asarray(track.circle),
    )


def _gate_axes(track: Track) -> np.ndarray | None:
    """Each gate's axes (gates, 3, 3) in the world, Q30; None where all gates are upright."""
    if track.attitude is None:
        return None
    axes = []
    for axis in np.eye(3):
        seen = world_to_body(track.attitude, Vec3(*jnp.float32(axis)))
        axes.append(np.stack([np.asarray(x, np.float64) for x in seen.components()], axis=1))
    return np.rint(np.stack(axes, axis=2) * ONE).astype(np.int64)


def _spans(policy: Policy, box: InputBox) -> dict[str, Spans]:
    """Exponents and integers of the scaled fields, those of a history under its field's name.

    Raises:
        InputError: a history with another scale than its field.
    """
    spans: dict[str, Spans] = {}
    for name in policy.layout.names:
        base = split_name(name)[0]
        if base in box.scaled:
            own = spans_of(policy, box, name)
            if spans.setdefault(base, own) != own:
                raise InputError(f"the policy's layout: {name} has another span than {base}")
    return spans


def next_gates(track: Track) -> dict[str, np.ndarray]:
    """The fields that depend only on the gate, (gates, size) float64 of each."""
    position = np.stack([np.asarray(c) for c in track.next_position.components()], 1)
    plain = np.roll(track.yaw, -1) - np.asarray(track.yaw)
    values = {
        "next_position": position,
        "next_yaw": np.asarray(track.next_yaw)[:, None],
        "next_yaw_unwrapped": plain[:, None],
    }
    for count, (place_field, yaw_field) in enumerate(NEXT_FIELDS, start=2):
        place, yaw = gates_ahead(track, count)
        values[place_field.name] = np.asarray(place.array())
        values[yaw_field.name] = np.asarray(yaw)[:, None]
    return {name: value.astype(np.float64) for name, value in values.items()}


def track_ranges(layout: Layout, track: Track) -> dict[str, float]:
    """The ranges by field that a track needs where they are above those of the layout.

    At the start of a leg, the distance to its gate is about that between the two gates.
    """
    needed = {name: np.abs(value).max() for name, value in next_gates(track).items()}
    needed["position"] = 1.25 * needed["next_position"]
    return {
        name: next_power(size)
        for name, size in needed.items()
        if name in layout and size > layout[name].range
    }


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
) -> tuple[StateField, ...]:
    """The fields of the state, with the ranges that the inputs computed from them need."""
    attitude, fields, start = box.exponent["attitude"], [], 0
    exponents = {
        "position": world,
        "velocity": box.exponent["velocity"] + WIND_EXPONENT,
        "rates": box.exponent["rates"],
        "quaternion": QUATERNION_EXPONENT,
    }
    for name, size in state_sizes(box.layout, model).items():
        scaled = spans.get(LAST_ACTION if name == LAST_COMMAND else name, [])
        own = [e for e, _ in scaled] or [exponents.get(name, UNOBSERVED)]
        if name == "euler":
            own = [attitude, attitude, YAW_EXPONENT]
        own = (own * size)[:size]  # of a force, only one number may be observed
        fields.append(StateField(name, NOTES.get(name, "actuators"), start, tuple(own)))
        start += size
    return tuple(fields)


def _inputs(
    box: InputBox, fields: tuple[StateField, ...], spans: dict[str, Spans]
) -> tuple[Input, ...]:
    """How each field of the layout is computed."""
    starts, found, constants = {field.name: field.start for field in fields}, [], 0
    for field in box.layout.fields:
        (name, lag), index = split_name(field.name), box.layout.slice(field.name).start
        if name in KINDS:
            kind, source = KINDS[name]
            size = 4 if kind == ROTATION else field.size
            numbers = [starts[source] + i for i in range(size)]
        elif name in spans:
            axes = ["xyz".index(part[-1]) for part in DISTURBANCES.get(name, ())]
            first = starts[LAST_COMMAND if name == LAST_ACTION else name]
            kind, numbers = SCALED, [first + i for i in axes or range(field.size)]
        else:
            kind, numbers = GATE, list(range(constants, constants + field.size))
            constants += field.size
        rescales = tuple(rescale for _, rescale in spans.get(name, ()))
        found.append(Input(field.name, kind, index, tuple(numbers), rescales, lag))
    return tuple(found)
