"""A time-optimal flight: vehicle, gates, rules, start and end."""

import dataclasses
import functools
from typing import Any, Literal

import jax
import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.vectors import Vec3
from quadjax.limits.gates import Gates, gates_of
from quadjax.race.environment import RaceParams
from quadjax.race.rules import BENEATH, Frame, Landing
from quadjax.race.start import hover
from quadjax.race.track import Track
from quadjax.vehicle.protocol import Motion, State, VehicleModel, VehicleParams

NO_BOUNDS = ((-np.inf,) * 3, (np.inf, np.inf, 0.0))  # the ground is at z = 0
CENTERED = 0.02  # m from a center, within which a flight passes through it
Start = Literal["periodic", "hover"]


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """A flight whose time is to be as small as possible.

    Attributes:
        model: the vehicle model.
        vehicle: its constants and residual, in float64.
        track: gates and start.
        gates: of the track, in float64.
        passages: number of gates to pass, in the track's order, again from its first after its
            last; a periodic flight passes each gate once.
        start: ``periodic``: the state at the end is the state at the start, in the last gate;
            ``hover``: from the start of timed laps, at rest.
        stops: whether the flight ends at rest in the center of the last gate.
        clearance: distance from every edge of the openings, m; None: through the centers.
        bounds: lowest and highest position, m, (2, 3).
        rate_limit: largest body rates about x, y and z, rad/s, (3,).
        pitch_limit: rad.
        speed_limit: m/s.
        speed_rule: m/s, of the race; a faster flight is rejected.
        fitted_speed: highest speed of the flights that the model is fitted to, m/s.
        frame: solid frames around the openings.
        landing: largest speed near the ground; None: no flight below the ground.
        radius: of the drone, m. ``gates`` and ``bounds`` are already smaller by it.
    """

    model: VehicleModel
    vehicle: VehicleParams
    track: Track
    gates: Gates
    passages: int
    start: Start = "periodic"
    stops: bool = False
    clearance: float | None = 0.0
    bounds: np.ndarray = dataclasses.field(default_factory=lambda: np.array(NO_BOUNDS))
    rate_limit: np.ndarray = dataclasses.field(default_factory=lambda: np.full(3, np.inf))
    pitch_limit: float = np.inf
    speed_limit: float = 30.0
    speed_rule: float = np.inf
    fitted_speed: float = np.inf
    frame: Frame | None = None
    landing: Landing | None = None
    radius: float = 0.0

    def __post_init__(self) -> None:
        """Raise an ``InputError`` for a gate that no flight can pass."""
        _ = self.normalized  # computed here, outside of traced functions
        low, high = self.bounds
        for index in range(self.gate_count):
            half = self.gates.smallest(index)
            if self.clearance is not None and self.clearance >= half:
                raise InputError(
                    f"gate {index + 1}: a clearance of {self.clearance:g} m leaves no opening "
                    f"(half of its smaller side is {half:g} m)"
                )
            inside = self.gates.shrunk(index, self.clearance)
            if np.any(inside.max(axis=0) < low) or np.any(inside.min(axis=0) > high):
                raise InputError(
                    f"gate {index + 1}: unreachable, outside the bounds of the race and the ground"
                )
        start = leaves(self.model.position(self.hover_state))
        if self.start == "hover" and np.any((start < low) | (start > high)):
            raise InputError(f"the start at {start.round(3).tolist()} is outside the bounds")

    def leeway(self, index: int, place: np.ndarray) -> float:
        """How far, m, a passage of a gate is inside what the clearance leaves; negative outside.

        Through the centers, within ``CENTERED`` of the center.
        """
        if self.clearance is None:
            return float(CENTERED - np.linalg.norm(place - self.gates.position[index]))
        return self.gates.clearance(index, place) - self.clearance

    @property
    def gate_count(self) -> int:
        """Number of gates of the track."""
        return len(self.gates.position)

    @property
    def order(self) -> np.ndarray:
        """Indices of the gates to pass, one for each leg."""
        return np.arange(self.passages) % self.gate_count

    @functools.cached_property
    def hover_state(self) -> State:
        """The start of timed laps: hover at the track's start, or in the last gate."""
        with jax.enable_x64(True):
            return wide(hover(self.model, self.vehicle.constants, wide(self.track)))

    def hover_at(self, *motion: np.ndarray) -> np.ndarray:
        """Leaves of a state with the actuators of a hover.

        Args:
            motion: position, velocity, Euler angles and, if not zero, body rates, each (3,).
        """
        parts = [*motion, np.zeros(3)][:4]
        vectors = (Vec3.of(np.asarray(x, np.float64)) for x in parts)
        with jax.enable_x64(True):
            return leaves(self.model.hover(self.vehicle.constants, Motion(*vectors)))

    def specific_force(self, state: np.ndarray) -> np.ndarray:
        """The specific force (3,), m/s^2, body, of the leaves of a state."""
        with jax.enable_x64(True):
            return leaves(self.model.specific_force(self.vehicle, self.state(state)))

    @functools.cached_property
    def actuator_leaves(self) -> list[int]:
        """Indices of the leaves that are the actuators' state, in its order."""
        return self.leaf_indices("actuator_state")

    def leaf_indices(self, name: str) -> list[int]:
        """Indices of the leaves that a function of the model returns, in its order."""
        start = self.hover_at(*np.zeros((3, 3)))
        read = getattr(self.model, name)
        base = leaves(read(self.state(start)))
        found: dict[int, int] = {}
        for index in range(len(start)):
            moved = start.copy()
            moved[index] += 1.0
            (changed,) = np.nonzero(np.abs(leaves(read(self.state(moved))) - base) > 0.5)
            if len(changed) == 1:
                found[int(changed[0])] = index
        return [found[row] for row in range(len(base))]

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
        moved = leaves(self.hover_state) + 0.3
        base = leaves(self.model.wrap(self.state(moved)))
        found = np.zeros(len(moved), bool)
        for index in range(len(moved)):
            turned = moved.copy()
            turned[index] += 2.0 * np.pi
            wrapped = leaves(self.model.wrap(self.state(turned)))
            found[index] = abs(wrapped[index] - turned[index]) > 1.0 and np.allclose(
                wrapped, base, atol=1e-4
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
    model: VehicleModel,
    params: RaceParams,
    world_box: bool = False,
    *,
    passages: int | None = None,
    waypoint: float | None = None,
    **options: Any,
) -> Problem:
    """The time-optimal flight of a race.

    Args:
        model: the vehicle model.
        params: the numbers of the race; training limits are ignored.
        world_box: the rule ``gate_test: world_box``.
        passages: number of gates to pass; None: each of the track once.
        waypoint: as of ``gates_of``.
        options: further fields of ``Problem``.

    Raises:
        InputError: a gate that cannot be passed.
    """
    limits = params.limits
    radius = 0.0 if limits.body_radius is None else float(limits.body_radius)
    bounds = np.array(NO_BOUNDS)
    bounds[1, 2] = -radius if limits.landing is None else BENEATH
    edge = float(limits.position)
    bounds[:, :2] = [[-edge] * 2, [edge] * 2]
    if limits.bounds is not None:
        low, high = (leaves(end) for end in limits.bounds)
        inner = np.maximum(bounds[0], low + radius), np.minimum(bounds[1], high - radius)
        bounds = np.array(inner)
    gates = gates_of(params.track, world_box, waypoint, radius)
    if not params.track.closed:
        options["start"] = "hover"
    fields = {"bounds": bounds, "frame": limits.frame, "landing": limits.landing} | options
    fields["radius"] = radius
    axes = np.full(3, float(limits.body_rate))
    if limits.axis_rates is not None:
        axes = leaves(limits.axis_rates)
    return Problem(
        model,
        wide(params.vehicle),
        params.track,
        gates,
        len(gates.position) if passages is None else passages,
        pitch_limit=float(model.pitch_limit),
        **({"rate_limit": axes} | fields),
    )
