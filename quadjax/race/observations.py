"""What a policy observes: the table ``OBSERVATIONS`` of named fields, and layouts made of them.

Sizes, slices, scaling, the conversion between two policies' scalings and the ranges of the exported
code derive from the ``Layout``. The default one is that of Ferede et al. (arXiv 2311.16948): 24
numbers for the motor-level vehicle, 17 for the rate-level one.

A field of the history, ``velocity@5``, is the field ``velocity`` of the state of 5 steps before,
seen from the present target gate: all fields of an observation have one frame, also in the steps
after a gate. At the start of an episode all earlier states are the first one.
"""

import functools
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp

from quadjax.core.errors import InputError
from quadjax.core.frames import wrap_angle
from quadjax.core.vectors import Vec3, between
from quadjax.race.layout import (
    ESTIMATED,
    LAST_ACTION,
    NONE,
    PUBLISHED,
    Bounds,
    Layout,
    Numbers,
    Observation,
    ObservedField,
    Source,
    delayed,
)
from quadjax.race.track import gates_ahead, pick, to_gate_frame, unwrapped_turns
from quadjax.race.types import RaceParams, Step
from quadjax.vehicle.battery import LOWEST, highest_rpm
from quadjax.vehicle.protocol import VehicleModel

HIGHEST_RPM, CONSTANTS, MOST_AHEAD = "highest_rpm", "constants", 4
ACTUATORS = "actuators"  # in a history: the field of the model's actuators, whatever its name

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


def _beyond(count: int) -> tuple[ObservedField, ObservedField]:
    """Position and yaw of the gate that is ``count`` gates after the target."""

    def position(step: Step) -> Numbers:
        place, _ = gates_ahead(step.params.track, count)
        return [pick(table, step.state.target) for table in place.components()]

    def yaw(step: Step) -> Numbers:
        _, turn = gates_ahead(step.params.track, count)
        return (pick(turn, step.state.target),)

    def when(observed: Observation, *_: object) -> bool:
        return observed.gates_ahead >= count

    place = ObservedField(f"next{count}_position", 3, "m", "gate", 16.0, position, when=when)
    return place, ObservedField(f"next{count}_yaw", 1, "rad", "gate", 4.0, yaw, when=when)


def _last_action(step: Step) -> Numbers:
    """The command of the step before, which the range of commands scales to the action."""
    assert step.state.action is not None
    low, high = map(jax.tree.leaves, _command_range(step.model, step.params))
    return [between(*x) for x in zip(low, high, step.state.action, strict=True)]


def _constants(step: Step) -> Numbers:
    """Every constant of the drone, in the model's order and its units.

    A drone that differs from its model (``vehicle.mismatch``) shows those of the model.
    """
    constants, nominal = step.state.constants, step.params.vehicle.constants
    unknown = constants is None or step.params.mismatch is not None
    return jax.tree.leaves(nominal if unknown else constants)


def _disturbance(source: Source, step: Step) -> tuple[Vec3, Vec3]:
    """The external moment, N m, and specific force, m/s^2, body, as they are observed."""
    if source == ESTIMATED:
        assert step.state.estimate is not None
        return step.state.estimate.moment, step.state.estimate.force
    return (Vec3.zero(), Vec3.zero()) if source == NONE else step.drone.disturbance


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


# Scales: of the nominal drone, as drawn constants are not known to a policy.


def _command_range(model: VehicleModel, params: RaceParams) -> Bounds:
    return model.command_range(params.vehicle.constants)


def _limit_range(model: VehicleModel, params: RaceParams) -> Bounds:
    highest = jax.tree.leaves(_command_range(model, params)[1])[0]
    return (LOWEST * highest,), (highest,)


def _constant_range(model: VehicleModel, params: RaceParams) -> Bounds:
    """The nominal constants minus and plus the drawn differences.

    Of a population, whose limits are not known, the constants minus and plus their size.
    """
    nominal = jax.tree.leaves(params.vehicle.constants)
    widths = [jnp.abs(x) for x in nominal]
    if params.population_width is None:
        spread = jax.tree.leaves(params.randomization)
        widths = [width * part for width, part in zip(widths, spread, strict=True)]
    pairs = list(zip(nominal, widths, strict=True))
    return tuple(x - width for x, width in pairs), tuple(x + width for x, width in pairs)


# The observed disturbances by field, as the section ``disturbance`` of a config names them.
DISTURBANCES = {"moment_ext": ("moment_x", "moment_y", "moment_z"), "force_ext": ("force_z",)}
NEXT_FIELDS = tuple(_beyond(count) for count in range(2, MOST_AHEAD + 1))


def _is(key: str, value: object) -> Callable[[Observation, VehicleModel, bool], bool]:
    """A field's ``when``: a key of the section has this value."""
    return lambda observed, *_: getattr(observed, key) == value


# Fields that depend on the vehicle model or on the source of their numbers.


def _actuators(model: VehicleModel, observed: Observation) -> ObservedField:
    span, size = observed.actuator_range, model.actuators.size

    def value(step: Step) -> Numbers:
        return jax.tree.leaves(step.drone.actuators)

    def scale(model: VehicleModel, params: RaceParams) -> Bounds:
        if span is None:
            return model.actuator_range(params.vehicle.constants)
        return (jnp.float32(span[0]),) * size, (jnp.float32(span[1]),) * size

    numbers = (*model.actuators, "body", 2.0, value, scale)
    return ObservedField(*numbers, has_history=True, when=_is("actuators", True))


def _external(
    name: str, unit: str, axes: str, model: VehicleModel, observed: Observation
) -> ObservedField:
    """An observed disturbance: the moment or the force."""
    index, keys, source = list(DISTURBANCES).index(name), DISTURBANCES[name], observed.disturbance

    def value(step: Step) -> Numbers:
        return [getattr(_disturbance(source, step)[index], axis) for axis in axes]

    def width(_: VehicleModel, params: RaceParams) -> Bounds:
        return None, [getattr(params.observed_disturbance, key) for key in keys]

    return ObservedField(
        name,
        *(len(axes), unit, "body", 2.0, value, width, source),
        when=lambda observed, model, battery: model.disturbed,
    )


# Every field, in the order of an observation, or a function ``(model, observed) -> field``. A race
# observes those whose ``when`` is true.
OBSERVATIONS: tuple[ObservedField | Callable[[VehicleModel, Observation], ObservedField], ...] = (
    ObservedField("position", 3, "m", "gate", 8.0, _position, has_history=True),
    ObservedField("velocity", 3, "m/s", "gate", 16.0, _velocity, has_history=True),
    ObservedField(
        "attitude",
        3,
        "rad",
        "gate",
        4.0,
        _attitude,
        has_history=True,
        when=_is("attitude", "euler"),
    ),
    ObservedField(
        "rotation",
        6,
        "",
        "gate",
        2.0,
        _rotation,
        has_history=True,
        when=_is("attitude", "rotation"),
    ),
    ObservedField("rates", 3, "rad/s", "body", 16.0, _rates, has_history=True),
    _actuators,
    ObservedField("next_position", 3, "m", "gate", 8.0, _next_position),
    ObservedField("next_yaw", 1, "rad", "gate", 4.0, _next_yaw, when=_is("wrap_next_yaw", True)),
    ObservedField(
        "next_yaw_unwrapped",
        *(1, "rad", "gate", 8.0, _next_yaw_unwrapped),
        when=_is("wrap_next_yaw", False),
    ),
    *(field for pair in NEXT_FIELDS for field in pair),
    lambda model, _: ObservedField(
        LAST_ACTION,
        *(model.action_size, "", "", 1.0, _last_action, _command_range),
        has_history=True,
        when=_is("last_action", True),
    ),
    functools.partial(_external, "moment_ext", "N m", "xyz"),
    functools.partial(_external, "force_ext", "m/s^2", "z"),
    lambda _, observed: ObservedField(
        HIGHEST_RPM,
        *(1, "rpm", "body", 2.0, functools.partial(_highest_rpm, observed.highest_rpm)),
        scale=_limit_range,
        when=lambda observed, _, battery: battery and observed.highest_rpm != NONE,
    ),
    lambda model, _: ObservedField(
        CONSTANTS,
        *(len(model.constant_names), "", "", 8.0, _constants, _constant_range),
        when=_is("constants", True),
    ),
)


@functools.cache  # the functions of equal fields are the same, so that programs are reused
def fields_of(
    model: VehicleModel, observed: Observation = PUBLISHED
) -> Mapping[str, ObservedField]:
    """Every field that a race of a vehicle model can give, by name.

    ``observed`` says where disturbances and the battery's limit come from.
    """
    rows = (row if isinstance(row, ObservedField) else row(model, observed) for row in OBSERVATIONS)
    return {field.name: field for field in rows}


def make_layout(
    model: VehicleModel,
    observed: Observation = PUBLISHED,
    extra: Sequence[ObservedField] = (),
    battery: bool = False,
) -> Layout:
    """The observation of a vehicle model in the race; by default that of the publication.

    It has the fields of ``OBSERVATIONS`` that ``observed`` asks for, then the history. ``extra``
    are the objects that ``observed.extra`` names, loaded; they are at the end. The limit of a
    ``battery`` is observed where there is one.

    Raises:
        InputError: two fields of one name.
    """
    fields = fields_of(model, observed)
    now = [f for f in fields.values() if f.when is None or f.when(observed, model, battery)]
    past = []
    for lag in observed.history.lags if observed.history else ():
        for name in observed.history.fields if observed.history else ():
            field = model.actuators.name if name == ACTUATORS else name
            past.append(delayed(fields[field], lag))
    layout = Layout((*now, *past, *extra))
    if len(set(layout.names)) != len(layout.fields):
        raise InputError(f"observation fields {', '.join(layout.names)}: two have the same name")
    return layout


def history_names(model: VehicleModel, observed: Observation) -> list[str]:
    """The fields of which a history can be observed.

    They are the observed ones of the vehicle's motion, and its actuators and actions in any case.
    """
    always = (model.actuators.name, LAST_ACTION)
    fields = [f for f in fields_of(model, observed).values() if f.has_history]
    names = [
        f.name
        for f in fields
        if f.when is None or f.name in always or f.when(observed, model, False)
    ]
    return [*names, ACTUATORS]
