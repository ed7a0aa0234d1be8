"""The observation and the gates of a race as the numbers that the C computes them with, float32."""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.frames import world_to_body
from quadjax.core.vectors import Vec3
from quadjax.export.ranges import InputBox, next_gates
from quadjax.policy.file import Policy
from quadjax.race.environment import Race
from quadjax.race.layout import LAST_ACTION, ObservedField
from quadjax.race.observation_config import NONE
from quadjax.race.observations import DISTURBANCES, HIGHEST_RPM
from quadjax.race.track import Track
from quadjax.race.types import RaceParams
from quadjax.vehicle.airframe import RPM_PER_RAD_S
from quadjax.vehicle.battery import LOWEST

OF_GATE = "QJ_OF_GATE"  # constants of the target gate
FIELDS = {  # names of qj_field in qj.h, by field of a layout
    "position": "QJ_POSITION",
    "velocity": "QJ_VELOCITY",
    "attitude": "QJ_ATTITUDE",
    "rotation": "QJ_ROTATION",
    "rates": "QJ_RATES",
    "rpm": "QJ_ROTOR_SPEED",
    "rotor_speed": "QJ_ROTOR_SPEED",
    "thrust": "QJ_THRUST",
    LAST_ACTION: "QJ_LAST_COMMAND",
    "moment_ext": "QJ_MOMENT_EXT",
    "force_ext": "QJ_FORCE_EXT_Z",
    HIGHEST_RPM: "QJ_HIGHEST_RPM",
}
FIELD_NAMES = (*dict.fromkeys(FIELDS.values()), OF_GATE)  # numbered from 1 on, as qj_field
GATE = np.dtype([  # the floats of qj_gate
    ("position", "<f4", 3),
    ("axes", "<f4", (3, 3)),
    *((name, "<f4") for name in ("yaw", "cos_yaw", "sin_yaw", "half_width", "half_height")),
])  # fmt: skip
GATE_TESTS = ("square", "interpolated", "world_box")  # numbered from 0 on, as qj_gate_test


@dataclasses.dataclass(frozen=True)
class Observation:
    """What the C observes: the fields, how each input is scaled, and the gates."""

    box: InputBox  # of the inputs
    parts: tuple[tuple[str, int], ...]  # name of qj_field and size of each field, in order
    scales: np.ndarray  # (inputs, 2) float32: middle and factor
    gates: np.ndarray  # (gates,) of ``GATE``
    is_round: np.ndarray  # (gates,) bool
    constants: np.ndarray  # (gates, n) float32, inputs that depend on the gate alone
    gate_test: str
    time_step: float  # s, between observations

    @property
    def observed(self) -> set[str]:
        """The fields of the layout that are not zero whatever the state is."""
        ends = itertools.accumulate(size for _, size in self.parts)
        starts = zip(self.box.layout.names, (0, *ends), self.parts, strict=False)
        return {name for name, at, (_, size) in starts if np.any(self.scales[at : at + size, 1])}


def make_observation(
    box: InputBox, policy: Policy, environment: Race, params: RaceParams
) -> Observation:
    """The observation of a policy in a race.

    Raises:
        InputError: a span of no width, or a next gate outside the box.
    """
    spans = [
        _scale(policy, field, number)
        for field in policy.layout.fields
        for number in range(field.size)
    ]
    gates, is_round = _gates(params)
    return Observation(
        box=box,
        parts=tuple((FIELDS.get(f.name, OF_GATE), f.size) for f in policy.layout.fields),
        scales=np.array(spans, np.float32),
        gates=gates,
        is_round=is_round,
        constants=_gate_constants(box, params.track),
        gate_test=params.rules.gate_test,
        time_step=float(params.rules.time_step),
    )


def _scale(policy: Policy, field: ObservedField, number: int) -> tuple[float, float]:
    """Middle and factor of an input, of the number as the C has it."""
    span = _span(policy, field, number)
    unit = RPM_PER_RAD_S if field.name == "rpm" else 1.0  # rotor speeds are in rad/s in C
    if span is None:
        return 0.0, 1.0
    low, high = span
    if low == high == 0.0:
        return 0.0, 0.0  # a disturbance that the policy does not see
    return 0.5 * (low + high) / unit, 2.0 * unit / (high - low)


def _span(policy: Policy, field: ObservedField, number: int) -> tuple[float, float] | None:
    """The numbers that become -1 and 1; None of a field that is not scaled."""
    ends, size = (policy.command_low, policy.command_high), field.size
    if field.name in DISTURBANCES:
        half = field.span[number][1] if field.span and field.source != NONE else 0.0
        return -half, half
    if field.name not in ("rpm", "rotor_speed", "thrust", LAST_ACTION, HIGHEST_RPM):
        return None
    if field.span:
        low, high = field.span[number]
    elif field.name == HIGHEST_RPM:
        low, high = LOWEST * float(ends[1][0]), float(ends[1][0])
    else:
        low, high = (float(end[number - size]) for end in ends)
    if low == high:
        raise InputError(
            f"the policy's layout: {field.name} has a span of {[low, high]}, allowed: a width "
            "above zero"
        )
    return low, high


def _gates(params: RaceParams) -> tuple[np.ndarray, np.ndarray]:
    """The gates, narrower by the radius of the drone's body; and which are round."""
    track, radius = params.track, params.rules.body_radius
    less = 0.0 if radius is None else float(radius)
    gates = np.zeros(len(track.yaw), GATE)
    gates["position"] = np.stack([np.asarray(x) for x in track.position.components()], axis=1)
    gates["axes"] = _axes(track)
    for name in ("yaw", "cos_yaw", "sin_yaw"):
        gates[name] = np.asarray(getattr(track, name))
    for name in ("half_width", "half_height"):
        gates[name] = np.asarray(getattr(track, name)) - np.float32(less)
    circle = np.zeros(len(gates), bool) if track.circle is None else np.asarray(track.circle)
    return gates, circle


def _axes(track: Track) -> np.ndarray:
    """Each opening's axes (gates, 3, 3) in the world, in rows: through, width, height."""
    if track.attitude is None:
        cosine, sine = np.asarray(track.cos_yaw), np.asarray(track.sin_yaw)
        zero, one = np.zeros_like(cosine), np.ones_like(cosine)
        rows = (cosine, sine, zero, -sine, cosine, zero, zero, zero, one)
        return np.stack(rows, axis=1).reshape(-1, 3, 3)
    columns = []
    for axis in np.eye(3):
        seen = world_to_body(track.attitude, Vec3(*jnp.float32(axis)))
        columns.append(np.stack([np.asarray(x) for x in seen.components()], axis=1))
    return np.stack(columns, axis=2)


def _gate_constants(box: InputBox, track: Track) -> np.ndarray:
    """The inputs that depend only on the gate, (gates, n) in the order of the layout."""
    values, columns = next_gates(track), [np.zeros((len(track.yaw), 0))]
    for name in [name for name in box.layout.names if name in values]:
        numbers, limit = values[name], box.limit(name)
        for gate, column in np.argwhere(np.abs(numbers) > limit):
            raise InputError(
                f"gate {gate}: {name} is {numbers[gate, column]:.4g}, declared +-{limit:g}; "
                f"declare more with --range {name}={2 * limit:g}"
            )
        columns.append(numbers)
    return np.concatenate(columns, axis=1).astype(np.float32)
