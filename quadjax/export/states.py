"""The state that the exported C observes, as the environment has it, and as the C has it."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core import quaternion
from quadjax.core.quaternion import Quaternion
from quadjax.core.vectors import Rotors, Vec3
from quadjax.export.race_source import PolicyRace
from quadjax.policy.pilot import command_ranges
from quadjax.race import episode
from quadjax.race.environment import Race
from quadjax.race.layout import LAST_ACTION, Layout
from quadjax.race.memory import DISTURBANCE, Estimate
from quadjax.race.observations import HIGHEST_RPM
from quadjax.race.types import RaceParams, RaceState
from quadjax.vehicle.airframe import RPM_PER_RAD_S
from quadjax.vehicle.battery import Battery, BatteryState, battery_at_start
from quadjax.vehicle.protocol import State, VehicleModel

LAST_COMMAND = "last_command"  # field of the state that the field LAST_ACTION is scaled from
SIZES = {  # of the fields of a state but for the actuators
    "position": 3,
    "velocity": 3,
    "euler": 3,
    "quaternion": 4,
    "rates": 3,
    "moment_ext": 3,
    "force_ext": 3,
    HIGHEST_RPM: 1,
    LAST_COMMAND: 4,
}
STATE = np.dtype([  # qj_state
    ("position", "<f4", 3), ("velocity", "<f4", 3), ("quaternion", "<f4", 4), ("rates", "<f4", 3),
    ("rotor_speed", "<f4", 4), ("thrust", "<f4"), (LAST_COMMAND, "<f4", 4),
    ("moment_ext", "<f4", 3), ("force_ext", "<f4", 3), (HIGHEST_RPM, "<f4"),
])  # fmt: skip


def state_sizes(layout: Layout, model: VehicleModel) -> dict[str, int]:
    """The fields of a state that a policy observes, and their sizes, in order.

    A policy that observes a rotation matrix gets a quaternion, any other one Euler angles.
    """
    names = ["position", "velocity"]
    names += [] if "rotation" in layout and "attitude" not in layout else ["euler"]
    names += ["quaternion"] if "rotation" in layout else []
    names += ["rates", model.actuators.name]
    names += ["moment_ext", "force_ext"] if model.disturbed else []
    names += [HIGHEST_RPM] if HIGHEST_RPM in layout else []
    names += [LAST_COMMAND] if LAST_ACTION in layout else []
    return {name: SIZES.get(name, model.actuators.size) for name in names}


def as_in_c(layout: Layout, model: VehicleModel, states: np.ndarray) -> np.ndarray:
    """States (n, sizes) of ``state_sizes`` as rows (n,) of ``STATE``."""
    sizes, rows = state_sizes(layout, model), np.zeros(len(states), STATE)
    parts = np.split(states, np.cumsum(list(sizes.values()))[:-1], axis=1)
    for name, part in zip(sizes, parts, strict=True):
        if name == "euler" and "quaternion" not in sizes:
            turned = jax.tree.leaves(quaternion.of_euler(Vec3(*part.T)))
            rows["quaternion"] = np.stack([np.asarray(x) for x in turned], axis=1)
        elif name == "rpm":
            rows["rotor_speed"] = part / RPM_PER_RAD_S
        elif name in (rows.dtype.names or ()):
            rows[name] = part.reshape(rows[name].shape)
    return rows


def example_state(environment: Race, params: RaceParams) -> State:
    """A vehicle's state as shapes."""
    return jax.eval_shape(functools.partial(episode.hover_start, environment), params).drone


def drone_of(layout: Layout, model: VehicleModel, example: State, numbers: jax.Array) -> State:
    """A vehicle's state of the numbers (n,) of an emitted one; ``example`` has its structure."""
    values = _by_name(state_sizes(layout, model), numbers)
    leaves = []
    for field in dataclasses.fields(example):
        if field.name == "attitude":
            leaves += _attitude(values, isinstance(example.attitude, Quaternion))
        elif getattr(example, field.name) is not None:
            leaves += values.get(field.name, values[model.actuators.name])
    return jax.tree.unflatten(jax.tree.structure(example), leaves)


def _by_name(sizes: dict[str, int], numbers: jax.Array) -> dict[str, list[jax.Array]]:
    index = iter(range(sum(sizes.values())))
    return {name: [numbers[next(index)] for _ in range(size)] for name, size in sizes.items()}


def _attitude(values: dict[str, list[jax.Array]], as_quaternion: bool) -> list[jax.Array]:
    """The attitude of a state's numbers: three angles, or a quaternion."""
    if as_quaternion and "quaternion" not in values:
        return jax.tree.leaves(quaternion.of_euler(Vec3(*values["euler"])))
    if not as_quaternion and "euler" not in values:
        # Close to a pitch of 90 deg the arcsine magnifies a rounding error of the length.
        unit = quaternion.normalized(Quaternion(*values["quaternion"]))
        return jax.tree.leaves(quaternion.to_euler(unit, jnp.arctan2))
    return values["quaternion" if as_quaternion else "euler"]


def observe(race: PolicyRace, states: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Observations (n, inputs) float32 of states (n, state_size) towards targets (n,).

    They are in the scaling that the policy was trained with.
    """
    environment, params, model = race.environment, race.params, race.environment.model
    example, sizes = example_state(environment, params), state_sizes(environment.layout, model)
    low, high = command_ranges(environment, params)

    @jax.jit
    @jax.vmap
    def observed(state: jax.Array, target: jax.Array) -> jax.Array:
        zero, numbers = jnp.zeros((), jnp.int32), _by_name(sizes, state)
        drone = drone_of(environment.layout, model, example, state)
        triples = zip(numbers.get(LAST_COMMAND, []), low, high, strict=False)
        action = tuple((2.0 * x - lowest - top) / (top - lowest) for x, lowest, top in triples)
        memories: dict[str, Any] = {LAST_ACTION: action}
        if params.estimator is not None and model.disturbed:
            memories |= {DISTURBANCE: Estimate(None, *drone.disturbance)}
        race_state = RaceState(drone, target, zero, zero, None, memories)
        if params.battery is not None and HIGHEST_RPM in sizes:
            (highest,) = numbers[HIGHEST_RPM]
            race_state = race_state.replace(battery=_battery(params.battery, highest))
        return environment.observation(params, race_state)

    return np.asarray(observed(states, targets))


def observe_float64(race: PolicyRace, states: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """As ``observe``, with states and parameters in float64: the rounding of float32 differs."""

    def exact(leaf: Any) -> Any:
        array = np.asarray(leaf)
        return array.astype(np.float64) if array.dtype == np.float32 else leaf

    with jax.enable_x64(True):
        same = dataclasses.replace(race, params=jax.tree.map(exact, race.params))
        return observe(same, states.astype(np.float64), targets)


def _battery(params: Battery, highest: jax.Array) -> BatteryState:
    """A battery of which the estimate of the highest speed is a number of the state, rpm."""
    state = battery_at_start(params, Rotors.same(jnp.zeros(())), None)
    return state.replace(estimate=state.estimate.replace(highest=highest))
