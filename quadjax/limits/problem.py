"""A time-optimal flight: a race's drone, gates and rules in float64, its start and its end.

A state is a vector (13 + actuators,): position, velocity, unit quaternion (body to world), body
rates, actuators. Models with Euler angles are solved with a quaternion, too.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.core.quaternion import Quaternion
from quadjax.race.environment import Race, without_training_limits
from quadjax.race.episode import hover_start
from quadjax.race.rules import TAKEOFF_DEPTH_M
from quadjax.race.track import Track
from quadjax.race.types import RaceParams, RaceState
from quadjax.vehicle.protocol import State, VehicleModel

POSITION, VELOCITY, ATTITUDE, RATES = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13)
ACTUATORS = slice(13, None)
CENTERED_M = 0.02  # from a center, within which a flight passes through it
TIME_STEP_S = 1e-3  # for which a command is held in the verification
DEFAULT_SPEED_M_S = 60.0  # the limit of a drone without ``fitted_speed``
BELOW_RULE = 0.998  # of a limit of the race, at the nodes: between them a flight may exceed it
Tree = TypeVar("Tree")


@dataclasses.dataclass(frozen=True, eq=False)
class Gates:
    """Gates in the order of passage."""

    position: np.ndarray  # (gates, 3) centers, m
    axes: np.ndarray  # (gates, 3, 3) unit vectors: through the opening, along its width, its height
    half_size: np.ndarray  # (gates, 2) half width, half height, m; the radius of a round opening
    circle: np.ndarray  # (gates,) bool, round openings

    def clearance(self, index: int, place: np.ndarray) -> float:
        """Distance of a place in the gate's plane from the nearest edge, m; negative outside."""
        width, height = self.half_size[index]
        _, right, down = self.axes[index] @ (place - self.position[index])
        if self.circle[index]:
            return float(width - np.hypot(right, down))
        return float(min(width - abs(right), height - abs(down)))


@dataclasses.dataclass(frozen=True)
class FlightOptions:
    """What is flown, in place of a periodic lap."""

    gates: int | None = None  # of a flight from the start; None: a periodic lap, or ``laps``
    laps: int | None = None  # of a flight from the start
    stops: bool = False  # ends at rest in the center of the last gate
    clearance: float | None = 0.0  # m from the edges of the openings; None: through the centers
    speed: float | None = None  # m/s, the limit; None: ``fitted_speed``, or ``DEFAULT_SPEED_M_S``
    fitted_speed: float | None = None  # m/s, highest of the flights that the model is fitted to


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """A flight whose time is to be as small as possible.

    A periodic flight ends, in the last gate, in the state in which it starts. Another one is from
    the start of timed laps, at rest.
    """

    environment: Race  # with RK4; gates are passed where the path crosses their planes
    params: RaceParams  # without training limits, in float64, with steps of 1 ms
    flight: FlightOptions
    gates: Gates  # of the track, smaller by the radius of the drone
    order: np.ndarray  # (legs,) indices of the gates to pass
    periodic: bool
    bounds: np.ndarray  # (2, 3) lowest and highest position, m
    rate_limit: np.ndarray  # (3,) largest body rates, rad/s
    speed_limit: float  # m/s
    pitch_limit: float  # rad; inf where the attitude is a quaternion in the race, too
    landing: tuple[float, float] | None  # m, below which flight is slower than a speed, m/s
    frame_depth: float | None  # m, of solid frames and the drone, on each side of a gate

    def __post_init__(self) -> None:
        """Compute the start outside of traced functions."""
        _ = self.start

    @property
    def model(self) -> VehicleModel:
        """The vehicle model, with a quaternion."""
        return self.environment.model

    def leeway(self, index: int, place: np.ndarray) -> float:
        """How far, m, a passage of a gate is inside what the clearance leaves; negative outside.

        Through the centers, within ``CENTERED_M`` of the center.
        """
        if self.flight.clearance is None:
            return float(CENTERED_M - np.linalg.norm(place - self.gates.position[index]))
        return self.gates.clearance(index, place) - self.flight.clearance

    @functools.cached_property
    def race_start(self) -> RaceState:
        """The start of timed laps: at rest at the track's start, or in the last gate."""
        with jax.enable_x64(True):
            return double(jax.jit(hover_start, static_argnums=0)(self.environment, self.params))

    @functools.cached_property
    def start(self) -> np.ndarray:
        """The state at the start of timed laps."""
        with jax.enable_x64(True):
            return np.asarray(self.vector(self.race_start.drone))

    @functools.cached_property
    def command_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest command."""
        low, high = self.model.command_range(self.params.vehicle.constants)
        return numbers(low), numbers(high)

    @functools.cached_property
    def _places(self) -> list[int]:
        """Which leaves of the model's state the entries of a vector are, by field."""
        leaves, structure = jax.tree.flatten(self.race_start.drone)
        indices = jax.tree.unflatten(structure, range(len(leaves)))
        nodes = jax.tree.leaves(indices, is_leaf=lambda node: isinstance(node, Quaternion))
        (attitude,) = (node for node in nodes if isinstance(node, Quaternion))
        fields = indices.position, indices.velocity, attitude, indices.rates
        return jax.tree.leaves((*fields, indices.actuators))

    def state(self, vector: np.ndarray | jax.Array) -> State:
        """The model's state of a vector; its disturbances are zero."""
        leaves, structure = jax.tree.flatten(self.race_start.drone)
        for index, place in enumerate(self._places):
            leaves[place] = vector[index]
        return jax.tree.unflatten(structure, leaves)

    def vector(self, state: State) -> jax.Array:
        """The vector of a state of the model."""
        leaves = jax.tree.leaves(state)
        return jnp.stack([jnp.asarray(leaves[place]) for place in self._places])

    def slope(self, vector: jax.Array, command: jax.Array) -> jax.Array:
        """The time derivative of a state under the numbers of a command.

        The quaternion is normalized before: its length may drift on a coarse mesh and would then
        scale the thrust.
        """
        low, _ = self.model.command_range(self.params.vehicle.constants)
        numbers = [command[index] for index in range(command.shape[0])]
        held = jax.tree.unflatten(jax.tree.structure(low), numbers)
        state = self.state(vector).wrapped()
        return self.vector(self.model.derivative(self.params.vehicle, state, held))

    def vectors(self, motion: Sequence[np.ndarray], actuators: np.ndarray) -> np.ndarray:
        """States (n, 13 + actuators) without jumps of a quaternion's sign.

        ``motion`` is position, velocity, Euler angles (roll, pitch, yaw) and body rates, (n, 3)
        each.
        """
        position, velocity, euler, rates = motion
        quaternion = Rotation.from_euler("ZYX", euler[:, ::-1]).as_quat()[:, [3, 0, 1, 2]]
        same = np.sum(quaternion[1:] * quaternion[:-1], axis=1) >= 0.0
        quaternion[1:] *= np.cumprod(np.where(same, 1.0, -1.0))[:, None]
        return np.concatenate([position, velocity, quaternion, rates, actuators], axis=1)


def to_euler(vectors: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw (n, 3), rad, of states (n, 13 + actuators)."""
    rotation = Rotation.from_quat(vectors[:, ATTITUDE][:, [1, 2, 3, 0]])
    return rotation.as_euler("ZYX")[:, ::-1]


def numbers(tree: Any) -> np.ndarray:
    """The leaves of a pytree of scalars, in float64."""
    return np.array([float(leaf) for leaf in jax.tree.leaves(tree)])


def double(tree: Tree) -> Tree:
    """A pytree of arrays with its floating-point numbers in float64."""
    arrays = jax.tree.map(np.asarray, tree)
    return jax.tree.map(lambda x: x.astype(np.float64) if x.dtype.kind == "f" else x, arrays)


def make_gates(track: Track, radius: float = 0.0) -> Gates:
    """The gates of a track, with openings that are smaller by a drone's radius, m, on each side.

    Raises:
        InputError: an opening is not wider than the drone.
    """
    position = np.stack([np.asarray(x, np.float64) for x in track.position.components()], 1)
    sizes = [np.asarray(x, np.float64) for x in (track.half_width, track.half_height)]
    half = np.stack(sizes, 1) - radius
    if np.any(half <= 0.0):
        gate = int(np.argmin(half.min(axis=1))) + 1
        raise InputError(f"gate {gate}: no wider than the drone, rules.body_radius {radius:g} m")
    yaw = np.asarray(track.yaw, np.float64)
    angles = np.stack([yaw, np.zeros_like(yaw), np.zeros_like(yaw)], axis=1)
    if track.attitude is not None:
        opening = {name: np.asarray(x, np.float64) for name, x in vars(track.attitude).items()}
        for column, name in ((1, "pitch"), (2, "roll")):
            angles[:, column] = np.arctan2(opening[f"sin_{name}"], opening[f"cos_{name}"])
    axes = Rotation.from_euler("ZYX", angles).as_matrix().transpose(0, 2, 1)
    circle = np.zeros(len(yaw), bool) if track.circle is None else np.asarray(track.circle)
    return Gates(position, axes, half, circle)


def make_problem(
    environment: Race, params: RaceParams, flight: FlightOptions | None = None
) -> Problem:
    """The time-optimal flight of a race, a periodic lap by default; training limits are ignored.

    Raises:
        InputError: a rule that is not supported, or a gate that cannot be passed.
    """
    flight = flight or FlightOptions()
    if params.rules.gate_test == "world_box":
        raise InputError("rules.gate_test: world_box is not supported by time-optimal laps")
    if params.battery is not None:
        raise InputError("battery: time-optimal laps do not support it, allowed: null")
    if params.track.closed and len(params.track.yaw) == 1:
        raise InputError("track.gates: a lap of one gate, allowed: two gates or more, or a course")
    model, params = environment.model, double(without_training_limits(environment.model, params))
    if math.isfinite(model.pitch_limit):
        model = model.with_options(quaternion=True)
    environment = dataclasses.replace(environment, model=model, integrator="rk4")
    rules = params.rules.replace(time_step=np.float64(TIME_STEP_S), gate_test="interpolated")
    limits = params.training_limits.replace(episode_steps=np.int32(10**9))
    params = params.replace(rules=rules, training_limits=limits)
    radius = 0.0 if rules.body_radius is None else float(rules.body_radius)
    gates = make_gates(params.track, radius)
    count = len(gates.position)
    ground = rules.ground_speed
    rates = math.inf if rules.body_rate_limit is None else rules.body_rate_limit
    fastest = math.inf if rules.speed_limit is None else float(rules.speed_limit)
    narrowest = int(np.argmin(gates.half_size.min(axis=1)))
    half = gates.half_size[narrowest].min()
    if flight.clearance is not None and flight.clearance >= half:
        raise InputError(
            f"gate {narrowest + 1}: a clearance of {flight.clearance:g} m leaves no opening "
            f"(half of its smaller side is {half:g} m)"
        )
    return Problem(
        environment=environment,
        params=params,
        flight=flight,
        gates=gates,
        order=np.arange(flight.gates or (flight.laps or 1) * count) % count,
        periodic=bool(params.track.closed and not (flight.gates or flight.laps or flight.stops)),
        bounds=_bounds(params, radius),
        rate_limit=BELOW_RULE * np.broadcast_to(np.asarray(rates, np.float64), 3),
        speed_limit=min(
            flight.speed or flight.fitted_speed or DEFAULT_SPEED_M_S, BELOW_RULE * fastest
        ),
        pitch_limit=float(jnp.radians(math.inf if limits.pitch_deg is None else limits.pitch_deg)),
        landing=None if ground is None else (float(rules.ground_height), float(ground)),
        frame_depth=rules.gate_frame and 0.5 * float(rules.gate_depth) + radius,
    )


def _bounds(params: RaceParams, radius: float) -> np.ndarray:
    """Lowest and highest position (2, 3) of the drone's center, m."""
    rules = params.rules
    edge = math.inf if rules.position_limit is None else float(rules.position_limit)
    ground = -radius if rules.ground_speed is None else TAKEOFF_DEPTH_M
    bounds = np.array([[-edge, -edge, -np.inf], [edge, edge, ground]])
    if rules.bounds is None:
        return bounds
    low, high = np.asarray(rules.bounds, np.float64).T
    return np.array([np.maximum(bounds[0], low + radius), np.minimum(bounds[1], high - radius)])
