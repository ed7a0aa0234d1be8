"""What a policy observes: the table ``fields_of`` of named fields, and layouts made of them.

Sizes, slices, scaling, the conversion between two policies' scalings and the ranges of the exported
code derive from the ``Layout``. The default one is that of Ferede et al. (arXiv 2311.16948): 24
numbers for the motor-level vehicle, 17 for the rate-level one.
"""

import functools
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp

from quadjax.core.errors import InputError
from quadjax.core.frames import wrap_angle
from quadjax.core.vectors import Vec3, from_unit
from quadjax.race.layout import LAST_ACTION, Bounds, Layout, Numbers, ObservedField
from quadjax.race.memory import DISTURBANCE
from quadjax.race.observation_config import ESTIMATED, NONE, PUBLISHED, Observation, Source
from quadjax.race.track import Span, gates_ahead, pick, to_gate_frame, unwrapped_turns
from quadjax.race.types import RaceParams, Step
from quadjax.vehicle.battery import LOWEST, highest_rpm
from quadjax.vehicle.protocol import VehicleModel

HIGHEST_RPM = "highest_rpm"
GATES_AHEAD = range(2, 5)  # gates after the target that may be observed, with the next one

# Values: functions of the step, whose state and gate are those that are observed.


def _in_gate(step: Step, vector: Vec3) -> Numbers:
    return to_gate_frame(step.gate, vector).components()


def _position(step: Step) -> Numbers:
    return _in_gate(step, step.position - step.gate.position)


def _velocity(step: Step) -> Numbers:
    return _in_gate(step, step.velocity)


def _rates(step: Step) -> Numbers:
    return step.body_rates.components()


def _attitude(step: Step) -> Numbers:
    """Roll, pitch, and the yaw's difference to the gate's, wrapped to [-pi, pi]."""
    euler = step.euler
    return euler.x, euler.y, wrap_angle(euler.z - step.gate.yaw)


def _rotation(step: Step) -> Numbers:
    """The body's x axis (front) and z axis (down) in the gate's frame."""
    g = step.gate
    zero, one = jnp.zeros_like(g.yaw), jnp.ones_like(g.yaw)
    rows = (g.cos_yaw, g.sin_yaw, zero), (-g.sin_yaw, g.cos_yaw, zero), (zero, zero, one)
    in_body = [step.drone.to_body(Vec3(*row)) for row in rows]
    return [axis.x for axis in in_body] + [axis.z for axis in in_body]


def _next_position(step: Step) -> Numbers:
    return step.gate.next_position.components()


def _next_yaw(step: Step) -> Numbers:
    return (step.gate.next_yaw,)


def _next_yaw_unwrapped(step: Step) -> Numbers:
    """The plain difference of the gates' yaws, as in the code of Ferede et al."""
    return (pick(unwrapped_turns(step.params.track), step.state.target),)


def _position_beyond(count: int, step: Step) -> Numbers:
    """The position of the gate that is ``count`` gates after the target."""
    place, _ = gates_ahead(step.params.track, count)
    return [pick(table, step.state.target) for table in place.components()]


def _yaw_beyond(count: int, step: Step) -> Numbers:
    """The yaw of the gate that is ``count`` gates after the target."""
    _, turn = gates_ahead(step.params.track, count)
    return (pick(turn, step.state.target),)


def _actuators(step: Step) -> Numbers:
    return jax.tree.leaves(step.drone.actuators)


def _last_action(step: Step) -> Numbers:
    """The command of the step before, which the range of commands scales to the action."""
    low, high = map(jax.tree.leaves, command_range(step.model, step.params))
    return [from_unit(*x) for x in zip(low, high, step.memories[LAST_ACTION], strict=True)]


def _disturbance(source: Source, step: Step) -> tuple[Vec3, Vec3]:
    """The external moment, N m, and specific force, m/s^2, body, as they are observed."""
    if source == ESTIMATED:
        estimate = step.memories[DISTURBANCE]
        return estimate.moment, estimate.force
    return (Vec3.zero(), Vec3.zero()) if source == NONE else step.drone.disturbance


def _moment(source: Source, step: Step) -> Numbers:
    return _disturbance(source, step)[0].components()


def _force_z(source: Source, step: Step) -> Numbers:
    return (_disturbance(source, step)[1].z,)


def _highest_rpm(source: Source, step: Step) -> Numbers:
    """The highest propeller speed (), rpm, that the battery permits; full speed for ``none``."""
    battery, params = step.state.battery, step.params.battery
    if source == NONE:
        return _limit_range(step.model, step.params)[1]
    assert battery is not None and params is not None
    if source == ESTIMATED:
        return (battery.estimate.highest,)
    limit = highest_rpm(params.cells, step.drone.actuators, battery.charge)
    return (jnp.minimum(limit, params.estimator.highest),)


# What fields are scaled by: ranges of the nominal drone, as a policy does not know drawn constants.


def command_range(model: VehicleModel, params: RaceParams) -> Bounds:
    """The lowest and highest command, which actions of -1 and 1 stand for."""
    ends = model.command_range(params.vehicle.constants)
    if params.ranges is None:
        return ends
    kind, count = jax.tree.structure(ends[0]), model.action_size
    low, high = ([end[i] for i in range(count)] for end in params.ranges.commanded)
    return jax.tree.unflatten(kind, low), jax.tree.unflatten(kind, high)


def _limit_range(model: VehicleModel, params: RaceParams) -> Bounds:
    highest = jax.tree.leaves(model.command_range(params.vehicle.constants)[1])[0]
    return (LOWEST * highest,), (highest,)


def _actuator_range(span: Span | None, model: VehicleModel, params: RaceParams) -> Bounds:
    if span is None:
        return model.actuator_range(params.vehicle.constants)
    low, high = ((jnp.float32(end),) * model.actuators.size for end in span)
    return low, high


def _half_widths(names: Sequence[str], _: VehicleModel, params: RaceParams) -> Bounds:
    return None, [getattr(params.disturbance, name) for name in names]


# The observed disturbances by field, as the section ``disturbance`` of a config names them.
DISTURBANCES = {"moment_ext": ("moment_x", "moment_y", "moment_z"), "force_ext": ("force_z",)}


@functools.cache  # the functions of equal fields are the same, so that programs are reused
def fields_of(
    model: VehicleModel, observed: Observation = PUBLISHED
) -> Mapping[str, ObservedField]:
    """Every field that a race of a vehicle model can give, by name, in the order of an observation.

    ``observed`` says where disturbances and the battery's limit come from.
    """
    bind, source, field = functools.partial, observed.disturbance, ObservedField
    moment, force = (bind(_half_widths, names) for names in DISTURBANCES.values())
    limit = bind(_highest_rpm, observed.highest_rpm)
    span = bind(_actuator_range, observed.actuator_range)
    table = [
        field("position", 3, "m", "gate", 8.0, _position),
        field("velocity", 3, "m/s", "gate", 16.0, _velocity),
        field("attitude", 3, "rad", "gate", 4.0, _attitude),
        field("rotation", 6, "", "gate", 2.0, _rotation),
        field("rates", 3, "rad/s", "body", 16.0, _rates),
        field(*model.actuators, "body", 2.0, _actuators, span, by_rotor=model.by_rotor),
        field("next_position", 3, "m", "gate", 8.0, _next_position),
        field("next_yaw", 1, "rad", "gate", 4.0, _next_yaw),
        field("next_yaw_unwrapped", 1, "rad", "gate", 8.0, _next_yaw_unwrapped),
    ]
    for count in GATES_AHEAD:
        place, yaw = bind(_position_beyond, count), bind(_yaw_beyond, count)
        table.append(field(f"next{count}_position", 3, "m", "gate", 16.0, place))
        table.append(field(f"next{count}_yaw", 1, "rad", "gate", 4.0, yaw))
    table += [
        field(
            *(LAST_ACTION, model.action_size, "", "", 1.0, _last_action, command_range),
            by_rotor=model.by_rotor,
        ),
        field("moment_ext", 3, "N m", "body", 2.0, bind(_moment, source), moment, source),
        field("force_ext", 1, "m/s^2", "body", 2.0, bind(_force_z, source), force, source),
        field(HIGHEST_RPM, 1, "rpm", "body", 2.0, limit, _limit_range),
    ]
    return {row.name: row for row in table}


def _conditions(
    model: VehicleModel, observed: Observation, battery: bool = False
) -> dict[str, bool]:
    """Whether a race observes a field, by name, of those that not every race observes."""
    ahead = {f"next{count}": observed.gates_ahead >= count for count in GATES_AHEAD}
    return {
        "attitude": observed.attitude == "euler",
        "rotation": observed.attitude == "rotation",
        model.actuators.name: observed.actuators,
        "next_yaw": observed.wrap_next_yaw,
        "next_yaw_unwrapped": not observed.wrap_next_yaw,
        **{f"{gate}_{x}": used for gate, used in ahead.items() for x in ("position", "yaw")},
        LAST_ACTION: observed.last_action,
        **dict.fromkeys(DISTURBANCES, model.disturbed),
        HIGHEST_RPM: battery and observed.highest_rpm != NONE,
    }


def make_layout(
    model: VehicleModel,
    observed: Observation = PUBLISHED,
    extra: Sequence[ObservedField] = (),
    battery: bool = False,
) -> Layout:
    """The observation of a vehicle model in the race; by default that of the publication.

    It has the fields of ``fields_of`` that ``observed`` asks for. ``extra`` are the objects that
    ``observed.extra`` names, loaded; they are at the end. The limit of a ``battery`` is observed
    where there is one.

    Raises:
        InputError: two fields of one name.
    """
    fields, used = fields_of(model, observed), _conditions(model, observed, battery)
    now = [field for name, field in fields.items() if used.get(name, True)]
    layout = Layout((*now, *extra))
    if len(set(layout.names)) != len(layout.fields):
        raise InputError(f"observation fields {', '.join(layout.names)}: two have the same name")
    return layout
