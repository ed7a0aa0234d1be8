"""Whole flights of the environment against the reference, command by command."""

import jax
import numpy as np
import pytest

from quadjax.core.traced import with_leaves
from quadjax.race.environment import RaceState, make_environment
from tests import reference as ref
from tests.convert import residual_of, rows_of, state_of
from tests.race.support import COURSE, by_rows, compiled_transition, make_race, race_state

COUNT, STEPS = 50, 30


def double(tree):
    return jax.tree.map(
        lambda x: np.asarray(x, np.float64) if np.issubdtype(x.dtype, np.floating) else x, tree
    )


def flight(choices, params, kind, rows, actions, constants=None):
    """Rows after every step of ``actions`` (steps, n, 4), in double precision."""
    count = np.zeros(len(rows), np.int32)
    state = RaceState(state_of(kind, rows), count, count, count, constants)
    kept = []
    for action in actions:
        state, _, _ = compiled_transition(choices)(double(params), state, action)
        kept.append(rows_of(state.drone))
    return np.stack(kept)


def command_rows(kind, c, actions, own=None):
    """The command of each action, within what the drone itself can do."""
    own = own or c
    unit = np.clip(actions, -1, 1)
    if kind == "motor":
        command = c["rpm_min"] + (unit + 1) / 2 * (c["rpm_max"] - c["rpm_min"])
        return np.clip(command, own["rpm_min"], own["rpm_max"])
    high = np.array([c["p_max"], c["q_max"], c["r_max"], c["thrust_max"]])
    low = np.array([-c["p_max"], -c["q_max"], -c["r_max"], c["thrust_min"]])
    bound = np.array([own["p_max"], own["q_max"], own["r_max"], own["thrust_max"]])
    floor = np.array([-own["p_max"], -own["q_max"], -own["r_max"], own["thrust_min"]])
    return np.clip(low + (unit + 1) / 2 * (high - low), floor, bound)


def reference_flight(kind, c, rows, commands, integrator, residual=None, dt=0.01):
    def slope(x, command):
        if kind == "rate":
            return ref.rate_derivative(c, x, command)
        return ref.motor_derivative(c, x, command, residual)

    kept = []
    for command in commands:
        k1 = slope(rows, command)
        if integrator == "rk4":
            k2 = slope(rows + dt / 2 * k1, command)
            k3 = slope(rows + dt / 2 * k2, command)
            k4 = slope(rows + dt * k3, command)
            k1 = (k1 + 2 * k2 + 2 * k3 + k4) / 6
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


@pytest.mark.parametrize(
    ("kind", "integrator"),
    [
        *(("motor", "euler"), ("rate", "euler"), ("motor", "rk4")),
        pytest.param("rate", "rk4", marks=pytest.mark.slow),
    ],
)
def test_flight_follows_the_reference(kind, integrator):
    choices, params = make_race(f"vehicle.model={kind}", f"vehicle.integrator={integrator}")
    c = {"motor": ref.MOTOR, "rate": ref.RATE}[kind]
    rows, actions = gentle(kind)
    residual = None
    with jax.enable_x64(True):
        exact = type(params.vehicle.constants)(**{k: np.float64(v) for k, v in c.items()})
        params = params.replace(vehicle=params.vehicle.replace(constants=exact))
        params = params.replace(rules=with_leaves(double(params.rules), time_step=np.float64(0.01)))
        if kind == "motor":
            residual = ref.random_residual(-1.0)
            vehicle = params.vehicle.replace(residual=residual_of(residual))
            params = params.replace(vehicle=vehicle)
        found = flight(choices, params, kind, rows, actions)
    commands = command_rows(kind, c, actions)
    close(found, reference_flight(kind, c, rows, commands, integrator, residual))


@pytest.mark.parametrize("kind", ["motor", "rate"])
def test_drawn_constants_are_flown_and_limit_the_command(kind):
    choices, params = make_race(f"vehicle.model={kind}", "randomization.limits=0.2")
    c = {"motor": ref.MOTOR, "rate": ref.RATE}[kind]
    own = {name: value * (1 + 0.1 * np.sin(i)) for i, (name, value) in enumerate(c.items())}
    rows, actions = gentle(kind)
    actions = np.sign(actions[:3]) * 1.5
    with jax.enable_x64(True):
        exact = type(params.vehicle.constants)(**{k: np.float64(v) for k, v in c.items()})
        params = params.replace(
            vehicle=params.vehicle.replace(constants=exact),
            rules=with_leaves(double(params.rules), time_step=np.float64(0.01)),
        )
        drawn = type(exact)(**{k: np.full(COUNT, v) for k, v in own.items()})
        found = flight(choices, params, kind, rows, actions, drawn)
    commands = command_rows(kind, c, actions, own)
    close(found, reference_flight(kind, own, rows, commands, "euler"))


def test_the_ends_of_a_step_stay_apart():
    """The last step of an episode, the last gate of a course, and both at once."""
    choices, params = make_race(*COURSE)
    forward = np.array([np.cos(ref.GATE_YAW[3]), np.sin(ref.GATE_YAW[3]), 0])
    rows = np.zeros((4, 22))
    rows[:, ref.P], rows[:, ref.V] = ref.GATES[3] - 2 * forward, 5 * forward
    rows[2:, ref.P] = ref.GATES[3] - 0.01 * forward
    rows[:, ref.RPM] = 7497
    step = by_rows(make_environment(choices).step)
    state = race_state("motor", rows, 3, [1198, 1199, 0, 1199])
    _, _, ended, truncated = step(params, state, np.zeros((4, 4), np.float32))
    np.testing.assert_array_equal(ended, [False, False, True, True])
    np.testing.assert_array_equal(truncated, [False, True, False, False])
