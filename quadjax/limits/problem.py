"""A time-optimal flight: vehicle, gates, rules, start and end."""

import dataclasses
import functools
from typing import Any, Literal

import jax
import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.vectors import Vec3
from quadjax.race.environment import RaceParams
from quadjax.race.rules import Frame
from quadjax.race.start import hover
from quadjax.race.track import Track
from quadjax.vehicle.protocol import Motion, State, VehicleModel, VehicleParams

NO_BOUNDS = ((-np.inf,) * 3, (np.inf, np.inf, 0.0))  # the ground is at z = 0
Start = Literal["periodic", "hover"]


@dataclasses.dataclass(frozen=True, eq=False)
class Gates:
    """Gates in the order of passage, in float64. World NED."""

    position: np.ndarray  # (gates, 3) m
    yaw: np.ndarray  # (gates,) rad
    half_size: np.ndarray  # (gates, 2) half width, half height, m
    world_box: bool = False  # the opening is the box |dx|, |dy|, |dz| of the authors' code

    @property
    def through(self) -> np.ndarray:
        """Unit vectors (gates, 3) of the direction of passage."""
        return np.stack([np.cos(self.yaw), np.sin(self.yaw), np.zeros_like(self.yaw)], axis=1)

    @property
    def right(self) -> np.ndarray:
        """Unit vectors (gates, 3) to the gate's right."""
        return np.stack([-np.sin(self.yaw), np.cos(self.yaw), np.zeros_like(self.yaw)], axis=1)

    def corners(self, index: int) -> np.ndarray:
        """Corners (4, 3) of a rectangle in the gate's plane that contains the opening, m."""
        width, height = self.half_size[index]
        if self.world_box:  # the largest lateral distance that the box allows
            width = width / max(abs(self.right[index][:2]))
        sides = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * [width, height]
        across = sides[:, :1] * self.right[index] + sides[:, 1:] * [0.0, 0.0, 1.0]
        return self.position[index] + across


def gates_of(track: Track, world_box: bool = False) -> Gates:
    """The gates of a track.

    Raises:
        InputError: tilted or round gates, which are not supported.
    """
    if track.opening is not None or (track.circle is not None and bool(track.circle.any())):
        raise InputError("track.gates: time-optimal laps support upright rectangular gates only")
    columns = [np.asarray(x, np.float64) for x in track.position.components()]
    sizes = [np.asarray(x, np.float64) for x in (track.half_width, track.half_height)]
    yaw = np.asarray(track.yaw, np.float64)
    return Gates(np.stack(columns, 1), yaw, np.stack(sizes, 1), world_box)


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """A flight whose time is to be as small as possible.

    Attributes:
        model: the vehicle model.
        vehicle: its constants and residual, in float64.
        track: gates and start.
        gates: of the track, in float64.
        laps: number of laps.
        start: ``periodic``: the state at the end is the state at the start, in the last gate;
            ``hover``: from the hover of timed laps.
        clearance: distance from every edge of the openings, m; None: through the centers.
        bounds: lowest and highest position, m, (2, 3).
        rate_limit: largest body rate about any axis, rad/s.
        pitch_limit: rad.
        speed_limit: m/s.
        frame: solid frames around the openings; used only by the verification.
    """

    model: VehicleModel
    vehicle: VehicleParams
    track: Track
    gates: Gates
    laps: int = 1
    start: Start = "periodic"
    clearance: float | None = 0.0
    bounds: np.ndarray = dataclasses.field(default_factory=lambda: np.array(NO_BOUNDS))
    rate_limit: float = np.inf
    pitch_limit: float = np.inf
    speed_limit: float = 30.0
    frame: Frame | None = None

    def __post_init__(self) -> None:
        """Raise an ``InputError`` for a gate that no flight can pass."""
        for index in range(self.gate_count):
            corners, half = self.gates.corners(index), self.gates.half_size[index].min()
            if self.clearance is not None and self.clearance >= half:
                raise InputError(
                    f"gate {index + 1}: a clearance of {self.clearance:g} m leaves no opening "
                    f"(half of its smaller side is {half:g} m)"
                )
            low, high = self.bounds
            if np.any(corners.max(axis=0) < low) or np.any(corners.min(axis=0) > high):
                raise InputError(
                    f"gate {index + 1}: unreachable, outside the bounds of the race and the ground"
                )

    @property
    def gate_count(self) -> int:
        """Number of gates of the track."""
        return len(self.gates.yaw)

    @property
    def order(self) -> np.ndarray:
        """Indices of the gates to pass, one for each leg."""
        return np.tile(np.arange(self.gate_count), self.laps)

    @functools.cached_property
    def hover_state(self) -> State:
        """The start of timed laps: hover at the track's start, or in the last gate."""
        with jax.enable_x64(True):
            return wide(hover(self.model, self.vehicle.constants, wide(self.track)))

    def hover_at(self, position: np.ndarray, velocity: np.ndarray, euler: np.ndarray) -> np.ndarray:
        """Leaves of a state with the actuators of a hover and a given motion, each (3,)."""
        vectors = (Vec3.of(np.asarray(x, np.float64)) for x in (position, velocity, euler))
        with jax.enable_x64(True):
            motion = Motion(*vectors, Vec3.of(np.zeros(3)))
            return leaves(self.model.hover(self.vehicle.constants, motion))

    @functools.cached_property
    def command_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest command, as leaves."""
        low, high = self.model.command_range(self.vehicle.constants)
        return leaves(low), leaves(high)

    @functools.cached_property
    def structure(self) -> tuple[Any, Any]:
        """Tree structures of the state and of the command."""
        low, _ = self.model.command_range(self.vehicle.constants)
        return jax.tree.structure(self.hover_state), jax.tree.structure(low)

    @functools.cached_property
    def angles(self) -> np.ndarray:
        """Which leaves of the state are angles (leaves,): ``model.wrap`` wraps them."""
        start = leaves(self.hover_state)
        found = np.zeros(len(start), bool)
        for index in range(len(start)):
            turned = start.copy()
            turned[index] += 2.0 * np.pi
            wrapped = leaves(self.model.wrap(self.state(turned)))
            found[index] = abs(wrapped[index] - turned[index]) > 1.0 and np.allclose(
                wrapped, start, atol=1e-4
            )
        return found

    @functools.cached_property
    def normalized(self) -> np.ndarray:
        """Which leaves are those of a quaternion (leaves,): ``model.wrap`` normalizes them."""
        start = leaves(self.hover_state)
        mixed = np.where(self.angles, start, start + 1.0)
        wrapped = leaves(self.model.wrap(self.state(mixed)))
        return (np.abs(wrapped - mixed) > 1e-3) & ~self.angles

    def state(self, values: Any) -> State:
        """The state of its leaves."""
        return jax.tree.unflatten(self.structure[0], list(values))

    def command(self, values: Any) -> Any:
        """The command of its leaves."""
        return jax.tree.unflatten(self.structure[1], list(values))


def leaves(tree: Any) -> np.ndarray:
    """The leaves of a pytree of scalars, in float64."""
    return np.array([float(leaf) for leaf in jax.tree.leaves(tree)])


def wide(tree: Any) -> Any:
    """A pytree of numbers in float64."""
    return jax.tree.map(lambda x: np.asarray(x, np.float64), tree)


def make_problem(
    model: VehicleModel, params: RaceParams, world_box: bool = False, **options: Any
) -> Problem:
    """The time-optimal flight of a race.

    Args:
        model: the vehicle model.
        params: the numbers of the race; training limits are ignored.
        world_box: the rule ``gate_test: world_box``.
        options: further fields of ``Problem``.

    Raises:
        InputError: a gate that cannot be passed.
    """
    limits = params.limits
    bounds = np.array(NO_BOUNDS)
    edge = float(limits.position)
    bounds[:, :2] = [[-edge] * 2, [edge] * 2]
    if limits.bounds is not None:
        low, high = (leaves(end) for end in limits.bounds)
        bounds = np.array([np.maximum(bounds[0], low), np.minimum(bounds[1], high)])
    if not params.track.closed:
        options["start"] = "hover"
    fields = {"bounds": bounds, "frame": limits.frame} | options
    return Problem(
        model,
        wide(params.vehicle),
        params.track,
        gates_of(params.track, world_box),
        rate_limit=float(limits.body_rate),
        pitch_limit=float(model.pitch_limit),
        **fields,
    )
