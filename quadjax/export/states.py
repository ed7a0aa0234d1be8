"""The state that the exported C observes, as the environment has it."""

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
from quadjax.export.race_tables import LAST_COMMAND, state_sizes
from quadjax.policy.pilot import command_ranges
from quadjax.race import episode
from quadjax.race.environment import Race
from quadjax.race.layout import LAST_ACTION, Layout
from quadjax.race.memory import DISTURBANCE, Estimate
from quadjax.race.observations import HIGHEST_RPM
from quadjax.race.types import RaceParams, RaceState
from quadjax.vehicle.battery import Battery, BatteryState, battery_at_start
from quadjax.vehicle.protocol import State, VehicleModel


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
