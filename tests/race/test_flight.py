"""Whole flights of the environment against the reference, command by command."""

import jax
import numpy as np
import pytest

from quadjax.race.types import RaceState
from tests import reference as ref
from tests.convert import residual_of, rows_of, state_of
from tests.race.support import compiled_transition, make_race

COUNT, STEPS = 50, 30
CONSTANTS = {"motor": ref.MOTOR, "rate": ref.RATE}


def double(tree):
    return jax.tree.map(
        lambda x: np.asarray(x, np.float64) if np.issubdtype(x.dtype, np.floating) else x, tree
    )


def flight(race, kind, rows, actions, drawn=None, residual=None):
    """Rows after every step of ``actions`` (steps, n, 4), in double precision."""
    environment, params = race
    with jax.enable_x64(True):
        nominal = type(params.vehicle.constants)
        exact = nominal(**{k: np.float64(v) for k, v in CONSTANTS[kind].items()})
        constants = drawn and nominal(**{k: np.full(COUNT, v) for k, v in drawn.items()})
        net = residual and residual_of(residual)
        rules = double(params.rules).replace(time_step=np.float64(0.01))
        vehicle = params.vehicle.replace(constants=exact, residual=net)
        params = double(params.replace(vehicle=vehicle, rules=rules))
        count = np.zeros(len(rows), np.int32)
        state, kept = RaceState(state_of(kind, rows), count, count, count, constants), []
        for action in actions:
            state, _, _ = compiled_transition(environment)(params, state, action)
            kept.append(rows_of(state.drone))
    return np.stack(kept)


def command_range(kind, c):
    if kind == "motor":
        return np.full(4, c["rpm_min"]), np.full(4, c["rpm_max"])
    rates = np.array([c["p_max"], c["q_max"], c["r_max"]])
    return np.append(-rates, c["thrust_min"]), np.append(rates, c["thrust_max"])


def reference_flight(kind, rows, actions, integrator="euler", drawn=None, residual=None, dt=0.01):
    """The same, with commands within what the drone itself can do."""
    c, (low, high) = drawn or CONSTANTS[kind], command_range(kind, CONSTANTS[kind])
    more = (residual,) if kind == "motor" else ()
    derivative = {"motor": ref.motor_derivative, "rate": ref.rate_derivative}[kind]
    commands = low + (np.clip(actions, -1, 1) + 1) / 2 * (high - low)
    kept = []
    for command in np.clip(commands, *command_range(kind, c)):

        def slope(x, command=command):
            return derivative(c, x, command, *more)

        k1 = slope(rows)
        if integrator == "rk4":
            k2 = slope(rows + dt / 2 * k1)
            k3 = slope(rows + dt / 2 * k2)
            k1 = (k1 + 2 * k2 + 2 * k3 + slope(rows + dt * k3)) / 6
        rows = rows + dt * k1
        rows[:, [6, 8]] = ref.wrap(rows[:, [6, 8]])
        kept.append(rows)
    return np.stack(kept)


def gentle(kind):
    rows = ref.random_states(kind, COUNT, seed=8)
    rows[:, ref.EULER] *= [0.2, 0.2, 1.0]
    rows[:, ref.RATES] *= 0.05
    rows[:, ref.V] *= 0.2
    if kind == "motor":
        rows[:, ref.RPM] = 7000 + 0.2 * (rows[:, ref.RPM] - 7000)
        rows[:, ref.MOMENT] *= 0.05
    draw = np.random.default_rng(9)
    mean = draw.uniform(-0.2, 0.2, (1, COUNT, 1))
    return rows, mean + draw.normal(0, 0.02, (STEPS, COUNT, 4))


def close(found, wanted):
    scale = np.maximum(np.abs(wanted).max(axis=(0, 1)), 1e-2)
    turned = np.abs(found[..., 8] - wanted[..., 8]) > 6
    found[..., 8] -= np.where(turned, np.sign(found[..., 8]) * 2 * np.pi, 0)
    assert np.max(np.abs(found - wanted) / scale) < 1e-7


@pytest.mark.parametrize(("kind", "integrator"), [("rate", "euler"), ("motor", "rk4")])
def test_flight_follows_the_reference(kind, integrator):
    race = make_race(f"vehicle.model={kind}", f"vehicle.integrator={integrator}")
    residual = ref.random_residual(-1.0) if kind == "motor" else None
    found = flight(race, kind, *gentle(kind), residual=residual)
    close(found, reference_flight(kind, *gentle(kind), integrator, residual=residual))


@pytest.mark.parametrize("kind", ["motor", "rate"])
def test_drawn_constants_are_flown_and_limit_the_command(kind):
    race = make_race(f"vehicle.model={kind}", "randomization.limits=0.2")
    constants = enumerate(CONSTANTS[kind].items())
    drawn = {name: value * (1 + 0.1 * np.sin(i)) for i, (name, value) in constants}
    rows, actions = gentle(kind)
    actions = np.sign(actions[:3]) * 1.5
    found = flight(race, kind, rows, actions, drawn)
    close(found, reference_flight(kind, rows, actions, drawn=drawn))
