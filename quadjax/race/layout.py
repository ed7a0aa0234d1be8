"""What a policy observes: a list of named fields.

Sizes, slices, scaling, the conversion between two policies' scalings and the ranges of the exported
code derive from the ``Layout``. The default one is that of Ferede et al. (arXiv 2311.16948): 24
numbers for the motor-level vehicle, 17 for the rate-level one.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.frames import wrap_angle
from quadjax.core.imports import own_numbers
from quadjax.core.vectors import Vec3, between
from quadjax.race import history, known_drone
from quadjax.race.track import Gate, gates_ahead, pick, to_gate_frame
from quadjax.vehicle.battery import LOWEST, highest_rpm
from quadjax.vehicle.protocol import State, VehicleModel

if TYPE_CHECKING:
    from quadjax.race.environment import RaceParams, RaceState

Bounds = tuple[Any, Any]  # pytrees of scalars: lowest (None: minus the highest) and highest
LAST_ACTION, HIGHEST_RPM, MOST_AHEAD = "last_action", "highest_rpm", 4  # gates
ACTUATORS = "actuators"  # in a history: the field of the model's actuators, whatever its name
GROUND_TRUTH, ESTIMATED, NONE = SOURCES = ("ground_truth", "estimated", "none")


@dataclasses.dataclass(frozen=True)
class View:
    """What a field is computed from: one drone in its race."""

    model: VehicleModel
    params: "RaceParams"
    state: "RaceState"
    gate: Gate  # the target

    @property
    def drone(self) -> State:
        """The vehicle's state."""
        return self.state.drone


@dataclasses.dataclass(frozen=True)
class Field:
    """One named group of numbers of an observation.

    Attributes:
        name: unique in a layout.
        size: number of scalars.
        unit: of the numbers before they are scaled.
        frame: "gate" (x through the target gate, y to its right, z down), "body" or "".
        range: largest magnitude of a network input, a power of two: the default of the export.
        value: ``(view) -> numbers``, each (), pure; None in the layout of a file.
        scale: ``(model, params) -> (lowest, highest)`` that are scaled to -1 and 1; a lowest of
            None is minus the highest, and a range of zero width gives zero. None: not scaled.
        source: where the numbers of a disturbance come from: one of ``SOURCES``.
        span: the numbers of ``scale``, one pair for each; None where unknown or not scaled.
    """

    name: str
    size: int
    unit: str
    frame: str
    range: float = 8.0
    value: Callable[[View], Sequence[jax.Array]] | None = None
    scale: Callable[[VehicleModel, "RaceParams"], Bounds] | None = None
    source: str = ""
    span: tuple[tuple[float, float], ...] | None = None

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for each number: ``name[0]`` .., or ``name`` alone."""
        return (
            tuple(f"{self.name}[{i}]" for i in range(self.size)) if self.size > 1 else (self.name,)
        )

    def numbers(self, view: View) -> list[jax.Array]:
        """The field's network inputs, after scaling."""
        assert self.value is not None, self.name
        values = own_numbers(f"observation field {self.name!r}", self.value, view, self.size)
        if self.scale is None:
            return values
        low, high = self.scale(view.model, view.params)
        highs = jax.tree.leaves(high)
        if low is None:
            pairs = zip(values, highs, strict=True)
            return [jnp.where(h > 0, x / jnp.where(h > 0, h, 1.0), 0.0) for x, h in pairs]
        triples = zip(values, jax.tree.leaves(low), highs, strict=True)
        return [scale_to_unit(x, least, most) for x, least, most in triples]


def scale_to_unit(value: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Map [low, high] to [-1, 1]; zero if the range has no width."""
    width = high - low
    return (2.0 * value - low - high) / jnp.where(width == 0, jnp.inf, width)


@dataclasses.dataclass(frozen=True)
class Layout:
    """The fields of an observation, in order."""

    fields: tuple[Field, ...]

    @property
    def size(self) -> int:
        """Total size of the fields."""
        return sum(field.size for field in self.fields)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the fields, in order."""
        return tuple(field.name for field in self.fields)

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for each number."""
        return tuple(label for field in self.fields for label in field.labels)

    @property
    def counts_steps(self) -> bool:
        """Whether a field is of an earlier step: a history, or the last action."""
        parts = map(history.split_name, self.names)
        return any(lag or name == LAST_ACTION for name, lag in parts)

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def __getitem__(self, name: str) -> Field:
        return self.fields[self.names.index(name)]

    def slice(self, name: str) -> slice:
        """Where a field's numbers are in the observation."""
        index = self.names.index(name)
        start = sum(field.size for field in self.fields[:index])
        return slice(start, start + self.fields[index].size)

    def numbers(self, view: View) -> list[jax.Array]:
        """All numbers of one observation, each ()."""
        return [number for field in self.fields for number in field.numbers(view)]

    def with_spans(self, model: VehicleModel, params: "RaceParams") -> "Layout":
        """The layout with the numbers of every scale."""
        return Layout(tuple(_with_span(field, model, params) for field in self.fields))

    def to_meta(self) -> list[dict[str, object]]:
        """The layout as JSON takes it; ``from_meta`` reads it back."""
        keys = ("name", "size", "unit", "frame", "range", "source", "span")
        return [{key: getattr(field, key) for key in keys} for field in self.fields]

    @staticmethod
    def from_meta(value: object, where: str) -> "Layout":
        """A layout from a file's JSON, without functions.

        Raises:
            InputError: not a list of fields; ``where`` names it.
        """
        if not isinstance(value, list) or not value:
            raise InputError(f"{where} is {value!r:.80}, expected a list of fields")
        layout = Layout(tuple(_field_of(item, f"{where}[{i}]") for i, item in enumerate(value)))
        if len(set(layout.names)) != len(layout.names):
            raise InputError(f"{where}: two fields have the same name")
        return layout


def _with_span(field: Field, model: VehicleModel, params: "RaceParams") -> Field:
    if field.scale is None:
        return field
    low, high = field.scale(model, params)
    highs = [float(x) for x in jax.tree.leaves(high)]
    lows = [-x for x in highs] if low is None else [float(x) for x in jax.tree.leaves(low)]
    return dataclasses.replace(field, span=tuple(zip(lows, highs, strict=True)))


def _field_of(item: object, where: str) -> Field:
    """A field of a file, checked."""
    known = {"name": str, "size": int, "unit": str, "frame": str, "range": float, "source": str}
    item = (
        {"unit": "", "frame": "", "range": 8.0, "source": ""} | item
        if isinstance(item, dict)
        else {}
    )
    for key, kind in known.items():
        allowed = (int, float) if kind is float else kind
        if not isinstance(item.get(key), allowed) or isinstance(item.get(key), bool):
            raise InputError(f"{where}.{key} is {item.get(key)!r:.80}, expected a {kind.__name__}")
    if not 1 <= item["size"] <= 4096:
        raise InputError(f"{where}.size is {item['size']}, allowed: 1 to 4096")
    span = item.get("span")
    if span is not None:
        try:
            pairs = np.asarray(span, np.float64)
        except (TypeError, ValueError):
            pairs = np.zeros(0)
        fine = pairs.shape == (item["size"], 2) and np.all(np.isfinite(pairs))
        if not fine or np.any(pairs[:, 0] > pairs[:, 1]):
            raise InputError(f"{where}.span is {span!r:.80}, expected a [low, high] per number")
        span = tuple((low, high) for low, high in pairs.tolist())
    return Field(**{key: item[key] for key in known}, span=span)


def _position(view: View) -> Sequence[jax.Array]:
    position = view.model.position(view.drone)
    return to_gate_frame(view.gate, position - view.gate.position).components()


def _velocity(view: View) -> Sequence[jax.Array]:
    return to_gate_frame(view.gate, view.model.velocity(view.drone)).components()


def _attitude(view: View) -> Sequence[jax.Array]:
    """Roll, pitch, and the yaw's difference to the gate's, wrapped to [-pi, pi]."""
    euler = view.model.euler(view.drone)
    return euler.x, euler.y, wrap_angle(euler.z - view.gate.yaw)


def _rotation(view: View) -> Sequence[jax.Array]:
    """The body's x axis (front) and z axis (down) in the gate's frame."""
    model, g = view.model, view.gate
    zero, one = jnp.zeros_like(g.yaw), jnp.ones_like(g.yaw)
    axes = (
        Vec3(g.cos_yaw, g.sin_yaw, zero),
        Vec3(-g.sin_yaw, g.cos_yaw, zero),
        Vec3(zero, zero, one),
    )
    seen = [model.to_body(view.drone, axis) for axis in axes]
    return [axis.x for axis in seen] + [axis.z for axis in seen]


def _rates(view: View) -> Sequence[jax.Array]:
    return view.model.rates(view.drone).components()


def _actuators(view: View) -> Sequence[jax.Array]:
    return jax.tree.leaves(view.model.actuator_state(view.drone))


def _actuator_bounds(model: VehicleModel, params: "RaceParams") -> Bounds:
    """The nominal range: drawn constants are not known to a policy."""
    return model.actuator_range(params.vehicle.constants)


def _next_position(view: View) -> Sequence[jax.Array]:
    return view.gate.next_position.components()


def _next_yaw(view: View) -> Sequence[jax.Array]:
    return (view.gate.next_yaw,)


def _next_yaw_unwrapped(view: View) -> Sequence[jax.Array]:
    """The plain difference of the gates' yaws, as in the code of Ferede et al."""
    yaw = view.params.track.yaw
    return (pick(jnp.roll(yaw, -1) - yaw, view.state.target),)


def _beyond(count: int) -> tuple[Field, Field]:
    """Position and yaw of the gate that is ``count`` gates after the target."""

    def position(view: View) -> Sequence[jax.Array]:
        place, _ = gates_ahead(view.params.track, count)
        return [pick(table, view.state.target) for table in place.components()]

    def yaw(view: View) -> Sequence[jax.Array]:
        _, turn = gates_ahead(view.params.track, count)
        return (pick(turn, view.state.target),)

    return (
        Field(f"next{count}_position", 3, "m", "gate", 16.0, position),
        Field(f"next{count}_yaw", 1, "rad", "gate", 4.0, yaw),
    )


def _last_action(view: View) -> Sequence[jax.Array]:
    """The command of the step before, which ``_command_bounds`` scales to the action."""
    assert view.state.action is not None
    ends = view.model.command_range(view.params.vehicle.constants)
    low, high = (jax.tree.leaves(end) for end in ends)
    return [between(*x) for x in zip(low, high, view.state.action, strict=True)]


def _command_bounds(model: VehicleModel, params: "RaceParams") -> Bounds:
    return model.command_range(params.vehicle.constants)


def last_action(size: int) -> Field:
    """The action of the step before."""
    return Field(LAST_ACTION, size, "", "", 1.0, _last_action, _command_bounds)


def _estimated_limit(view: View) -> Sequence[jax.Array]:
    assert view.state.battery is not None
    return (view.state.battery.estimate.highest,)


def _true_limit(view: View) -> Sequence[jax.Array]:
    charged, cells = view.state.battery, view.params.battery
    assert charged is not None and cells is not None
    limit = highest_rpm(cells.cells, view.model.actuator_state(view.drone), charged.charge)
    return (jnp.minimum(limit, cells.estimator.highest),)


def _no_limit(view: View) -> Sequence[jax.Array]:
    _, high = view.model.command_range(view.params.vehicle.constants)
    return (jax.tree.leaves(high)[0],)


def _limit_bounds(model: VehicleModel, params: "RaceParams") -> Bounds:
    _, high = model.command_range(params.vehicle.constants)
    highest = jax.tree.leaves(high)[0]
    return (LOWEST * highest,), (highest,)


def _true_moment(view: View) -> Sequence[jax.Array]:
    return view.model.disturbance(view.drone)[0].components()


def _true_force(view: View) -> Sequence[jax.Array]:
    return (view.model.disturbance(view.drone)[1].z,)


def _estimated_moment(view: View) -> Sequence[jax.Array]:
    assert view.state.estimate is not None
    return view.state.estimate.moment.components()


def _estimated_force(view: View) -> Sequence[jax.Array]:
    assert view.state.estimate is not None
    return (view.state.estimate.force.z,)


def _no_moment(view: View) -> Sequence[jax.Array]:
    return Vec3.zero().components()


def _no_force(view: View) -> Sequence[jax.Array]:
    return (jnp.zeros(()),)


def _moment_bounds(model: VehicleModel, params: "RaceParams") -> Bounds:
    span = params.observed_disturbance
    return None, (span.moment_x, span.moment_y, span.moment_z)


def _force_bounds(model: VehicleModel, params: "RaceParams") -> Bounds:
    return None, (params.observed_disturbance.force_z,)


_SOURCES = {
    GROUND_TRUTH: (_true_moment, _true_force),
    ESTIMATED: (_estimated_moment, _estimated_force),
    NONE: (_no_moment, _no_force),
}
_LIMITS = {GROUND_TRUTH: _true_limit, ESTIMATED: _estimated_limit, NONE: _no_limit}
# The observed disturbances by field, as the section ``disturbance`` of a config names them.
DISTURBANCES = {"moment_ext": ("moment_x", "moment_y", "moment_z"), "force_ext": ("force_z",)}
ATTITUDES = {
    "euler": Field("attitude", 3, "rad", "gate", 4.0, _attitude),
    "rotation": Field("rotation", 6, "", "gate", 2.0, _rotation),
}
NEXT_YAW = Field("next_yaw", 1, "rad", "gate", 4.0, _next_yaw)
NEXT_YAW_UNWRAPPED = Field("next_yaw_unwrapped", 1, "rad", "gate", 8.0, _next_yaw_unwrapped)


AHEAD = tuple(_beyond(count) for count in range(2, MOST_AHEAD + 1))


def _fixed(
    model: VehicleModel, span: tuple[float, float]
) -> Callable[[VehicleModel, "RaceParams"], Bounds]:
    low, high = ((jnp.float32(end),) * model.actuators.size for end in span)
    return lambda model, params: (low, high)


def disturbance_fields(source: str) -> tuple[Field, Field]:
    """The external moment and the force along body z; ``source`` is one of ``SOURCES``."""
    moment, force = _SOURCES[source]
    return (
        Field("moment_ext", 3, "N m", "body", 2.0, moment, _moment_bounds, source),
        Field("force_ext", 1, "m/s^2", "body", 2.0, force, _force_bounds, source),
    )


def highest_command(source: str) -> Field:
    """The highest propeller speed that the battery permits; ``source`` is one of ``SOURCES``."""
    value = _LIMITS[source]
    return Field(HIGHEST_RPM, 1, "rpm", "body", 2.0, value, _limit_bounds, source)


def constants_field(model: VehicleModel) -> Field:
    """Every constant of the drone; those that are not drawn are observed as 0."""
    names = model.constant_names
    scaled = known_drone.bounds
    return Field(known_drone.CONSTANTS, len(names), "", "", 8.0, known_drone.numbers, scaled)


def make_layout(
    model: VehicleModel,
    disturbance: str = GROUND_TRUTH,
    wrap_next_yaw: bool = True,
    extra: Sequence[Field] = (),
    attitude: str = "euler",
    ahead: int = 1,
    with_last_action: bool = False,
    actuator_range: tuple[float, float] | None = None,
    highest_speed: str | None = None,
    earlier: Sequence[str] = (),
    lags: Sequence[int] = (),
    with_actuators: bool = True,
    with_constants: bool = False,
) -> Layout:
    """The observation of a vehicle model in the race.

    Args:
        model: its actuators are one field; a model without external disturbances observes none.
        disturbance: source of the disturbances: ``ground_truth``, ``estimated`` or ``none``.
        wrap_next_yaw: whether the next gate's relative yaw is wrapped to [-pi, pi], as in the
            paper, or left as the plain difference, as in the authors' code.
        extra: further fields, at the end.
        attitude: ``euler`` for roll, pitch and yaw, as published, or ``rotation`` for the body's x
            and z axes, which are continuous at any attitude.
        ahead: number of gates after the target that are observed.
        with_last_action: whether the action of the step before is observed.
        actuator_range: actuator states that are observed as -1 and 1; None: the nominal range.
        highest_speed: source of the battery's limit: as of the disturbances; None: not observed.
        earlier: names of fields, of ``remembered_names``, that are also observed as they were.
        lags: numbers of steps before, at each of which they are observed.
        with_actuators: whether the actuators' state is observed.
        with_constants: whether the drone's constants are observed.

    Raises:
        InputError: two fields of one name.
    """
    actuators = model.actuators
    own = Field(
        *(actuators.name, actuators.size, actuators.unit, "body", 2.0),
        value=_actuators,
        scale=_actuator_bounds if actuator_range is None else _fixed(model, actuator_range),
    )
    fields = (
        Field("position", 3, "m", "gate", 8.0, _position),
        Field("velocity", 3, "m/s", "gate", 16.0, _velocity),
        ATTITUDES[attitude],
        Field("rates", 3, "rad/s", "body", 16.0, _rates),
        *([own] if with_actuators else []),
        Field("next_position", 3, "m", "gate", 8.0, _next_position),
        NEXT_YAW if wrap_next_yaw else NEXT_YAW_UNWRAPPED,
        *(field for pair in AHEAD[: ahead - 1] for field in pair),
        *([last_action(model.action_size)] if with_last_action else []),
        *(disturbance_fields(disturbance) if model.disturbed else ()),
        *([] if highest_speed is None else [highest_command(highest_speed)]),
        *([constants_field(model)] if with_constants else []),
    )
    known = {field.name: field for field in (last_action(model.action_size), own, *fields)}
    known[ACTUATORS] = own
    past = [history.delayed(known[name], lag) for lag in lags for name in earlier]
    fields = (*fields, *past, *extra)
    layout = Layout(fields)
    if len(set(layout.names)) != len(fields):
        raise InputError(f"observation fields {', '.join(layout.names)}: two have the same name")
    return layout


def remembered_names(model: VehicleModel, attitude: str) -> tuple[str, ...]:
    """The fields of which a history can be observed: those of the vehicle's motion and actions."""
    motion = ("position", "velocity", ATTITUDES[attitude].name, "rates", model.actuators.name)
    return (*motion, ACTUATORS, LAST_ACTION)


def is_of_motion(name: str) -> bool:
    """Whether a field depends on the vehicle's motion and actions, so that it has a history."""
    return name not in (*DISTURBANCES, HIGHEST_RPM, known_drone.CONSTANTS) and not name.startswith(
        "next"
    )


def other_fields(actions: int) -> tuple[Field, ...]:
    """The fields that every race can give, in addition to those of its own layout."""
    pairs = (field for pair in AHEAD for field in pair)
    others = (NEXT_YAW, NEXT_YAW_UNWRAPPED, last_action(actions))
    return (*ATTITUDES.values(), *others, *pairs)


def arranged(layout: Layout, wanted: Layout, model: VehicleModel, name: str) -> Layout:
    """The layout with the fields of another one, in its order.

    Args:
        layout: of a race.
        wanted: of a policy.
        model: of the vehicle.
        name: the policy's file, for the message.

    Raises:
        InputError: the race has no such field, or one of another size.
    """
    others = (
        *other_fields(model.action_size),
        highest_command(NONE),  # without a battery: full speed
        constants_field(model),
        *disturbance_fields(NONE),
    )
    known = {field.name: field for field in (*others, *layout.fields)}
    for base, lag in map(history.split_name, wanted.names):
        if lag and base in known and is_of_motion(base):
            delayed = history.delayed(known[base], lag)
            known[delayed.name] = delayed
    for field in wanted.fields:
        if field.name not in known or known[field.name].size != field.size:
            raise InputError(
                f"{name}: observes {field.name!r} ({field.size}), which the race lacks; "
                f"it has {', '.join(f'{f.name} ({f.size})' for f in layout.fields)}"
            )
    return Layout(tuple(known[field.name] for field in wanted.fields))
