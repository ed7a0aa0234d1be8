from dataclasses import replace

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.fitting.axes import fit_axes
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.flight_log import read_logs, write_log
from quadjax.fitting.motors import fit_battery
from quadjax.fitting.nominal import (
    AXES,
    CONSTANTS,
    RACING_CONSTANTS,
    ModelInputs,
    angular_moment,
    nominal,
)
from quadjax.fitting.regression import Parameter, Problem, check_signs, solve
from quadjax.fitting.samples import Samples, airborne, prepare
from quadjax.fitting.signals import derivative, first_order, low_pass
from quadjax.vehicle.battery import BatteryConfig
from quadjax.vehicle.constants import replaced
from quadjax.vehicle.vehicle_file import read_vehicle
from tests import reference as ref

from .conftest import RACING_INERTIA
from .flights import hover, write_flights


def test_the_model_is_that_of_the_independent_reference(bebop):
    """Level and without disturbances, accelerations give the specific force and the moment."""
    rows, commands = ref.random_states("motor", 50), ref.random_commands("motor", 50)
    rows[:, ref.EULER], rows[:, ref.MOMENT], rows[:, ref.FORCE] = 0.0, 0.0, 0.0
    slope = ref.motor_derivative(ref.MOTOR, rows, commands)
    rates = rows[:, ref.RATES]
    force = slope[:, ref.V] - [0.0, 0.0, 9.81]
    moment = angular_moment(bebop, rates, slope[:, ref.RATES])
    motion = ModelInputs(rows[:, ref.RPM], slope[:, ref.RPM], rows[:, ref.V], rates)
    expected = np.concatenate([force, moment], axis=1)
    np.testing.assert_allclose(nominal(bebop, motion), expected, rtol=1e-9, atol=1e-12)


def test_a_constant_of_an_impossible_sign_keeps_its_value_and_the_others_account_for_it():
    draw = np.random.default_rng(0)
    names, columns = CONSTANTS["az"], draw.normal(size=(2000, len(CONSTANTS["az"])))
    columns += columns[:, :1]  # correlated
    truth = np.array([-0.2 if name == "k_z" else 2.0 for name in names])
    measured = columns @ truth + 0.1 * draw.normal(size=2000)
    parameters = [
        Parameter(name, 0.4 if name == "k_z" else 1.0, positive=True, small=name == "k_z")
        for name in names
    ]
    problem = {"group": "az", "parameters": parameters, "measured": measured, "columns": columns}
    blocks, noise = np.arange(2000) // 50, np.zeros_like(columns)
    fit = solve(Problem(**problem, blocks=blocks, noise=noise))
    values = np.array(list(fit.constants.values()))
    others = np.array([name != "k_z" for name in names])
    remainder = measured - 0.4 * columns[:, ~others][:, 0]
    expected = np.linalg.lstsq(columns[:, others], remainder, rcond=None)[0]
    np.testing.assert_allclose(values[~others], 0.4)
    np.testing.assert_allclose(values[others], expected, rtol=1e-9)
    assert any("k_z" in line and "impossible" in line for line in fit.warnings)


@pytest.mark.parametrize(
    ("true", "base", "kept"), [(0.05, 5.0, False), (-0.05, 5.0, False), (0.05, 0.08, True)]
)
def test_a_base_value_is_kept_where_the_logs_allow_it(true, base, kept):
    """The estimate is 0.05 or -0.05, with a standard error of 0.03."""
    draw = np.random.default_rng(0)
    column, noise = draw.normal(size=(2, 4000, 1))
    noise -= column * (noise * column).mean() / (column**2).mean()
    measured = true * column[:, 0] + 2.0 * noise[:, 0]
    fit = solve(
        Problem(
            group="ay",
            parameters=[Parameter("k_y", base, positive=True)],
            measured=measured,
            blocks=np.arange(4000) // 20,
            columns=column,
            noise=np.zeros_like(column),
        )
    )
    value, error = fit.constants["k_y"], fit.errors["k_y"]
    assert value == base if kept else abs(value - max(true, 0.0)) < 1e-3
    assert np.isinf(error) if kept else 0.02 < error < 0.04
    assert fit.r_squared > -0.01
    assert any(line.startswith("k_y (ay): ") for line in fit.warnings)
    assert any("0 is used: the logs exclude" in line for line in fit.warnings) == (true < 0.0)


def test_filter_has_no_phase_and_derivative_is_exact_enough():
    time = np.arange(4000) / 400.0
    slow = np.sin(2 * np.pi * 2.0 * time)
    inner = slice(200, -200)
    passed = 1.0 / (1.0 + (2.0 / 16.0) ** 4)  # forwards and backwards
    np.testing.assert_allclose(low_pass(slow, 400.0, 16.0)[inner], passed * slow[inner], atol=1e-3)
    slope = 2 * np.pi * 2.0 * np.cos(2 * np.pi * 2.0 * time)
    np.testing.assert_allclose(derivative(slow, 400.0), slope, atol=1e-2)
    with pytest.raises(InputError, match="low-pass of 16"):
        low_pass(slow, 30.0, 16.0)


def test_a_first_order_lag_of_held_commands():
    dt, tau = 0.002, 0.06
    followed = first_order(np.full((200, 2), 5.0), np.array([1.0, 5.0]), tau, dt)
    time = dt * np.arange(200)
    np.testing.assert_allclose(followed[:, 0], 5.0 - 4.0 * np.exp(-time / tau), rtol=1e-9)
    np.testing.assert_allclose(followed[:, 1], 5.0)


def samples_of(logs, constants):
    """Every row in flight."""
    return prepare(logs, constants, [airborne(log) for log in logs])


def lag_of(logs, tau):
    """The motors' lag, without a battery's limit."""
    rows = [airborne(log) for log in logs]
    return fit_battery(logs, 7500.0, BatteryConfig().filled(11000.0), rows, tau)[0]


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    write_flights(folder, 8)
    return read_logs(LogsConfig(files=["*.csv"], format="paparazzi"), folder)


def test_constants_of_a_known_model_come_back(bebop, flights):
    samples = samples_of(flights, bebop)
    for fit in fit_axes(samples, bebop.replace(k_w=1.0)):
        assert not fit.warnings and fit.condition < 10.0 and fit.r_squared > 0.97
        for name, value in fit.constants.items():
            truth, error = getattr(bebop, name), fit.errors[name]
            assert abs(value / truth - 1.0) < 0.02, name
            assert abs(value - truth) < 3.0 * error, name


def test_motor_lag_comes_back(flights):
    fit = lag_of(flights, 0.1)
    assert abs(fit.constants["tau"] / 0.06 - 1.0) < 0.01 and fit.r_squared > 0.99
    assert not fit.warnings and list(fit.constants) == ["tau"]
    without = ({k: x for k, x in log.signals.items() if k != "command"} for log in flights)
    unknown = lag_of([log.replace(signals=x) for log, x in zip(flights, without, strict=True)], 0.1)
    assert unknown.constants["tau"] == 0.1 and "no commanded" in unknown.warnings[0]


def test_hover_excites_little_and_says_so(bebop, tmp_path):
    write_log(tmp_path / "hover.csv", hover())
    logs = read_logs(LogsConfig(files=["hover.csv"], format="paparazzi"), tmp_path)
    fits = fit_axes(samples_of(logs, bebop), bebop)
    said = " ".join(line for fit in fits for line in fit.warnings)
    for name in ("k_x", "k_y", "k_z", "k_h", "k_pv", "k_qv", "k_rr"):
        assert f"{name} (" in said
    assert "k_w (" not in said
    lag = lag_of(logs, 0.06)
    assert lag.constants["tau"] == 0.06 and "never change" in lag.warnings[0]


def test_constants_of_an_impossible_sign_are_refused(bebop, flights):
    samples = samples_of(flights[:1], bebop)
    check_signs(fit_axes(samples, bebop))
    negated = replace(samples, measured=samples.measured * [1, 1, 1, -1, 1, 1])
    with pytest.raises(InputError, match=r"k_p = -1.*\(Mx\), expected above 0"):
        check_signs(fit_axes(negated, bebop))
    measured = np.array(samples.measured)
    measured[:, 5] -= 0.002 * samples.regressors["Mz"][:, 2]
    kept = fit_axes(replace(samples, measured=measured), bebop)[5]
    assert kept.constants["k_rr"] == bebop.k_rr and "impossible below 0" in kept.warnings[0]


def test_noise_that_hides_what_tells_constants_apart_is_not_compensated():
    """Two columns that differ by 1%, with noise of 1%, estimated as twice as much."""
    draw, count = np.random.default_rng(0), 4000
    common, difference = draw.normal(size=(2, count, 1))
    true = np.concatenate([common, common + 0.01 * difference], axis=1)
    noise = 0.01 * draw.normal(size=true.shape)
    fit = solve(
        Problem(
            group="Mx",
            parameters=[Parameter("a", 1.0), Parameter("b", 1.0)],
            measured=true.sum(axis=1) + 0.01 * draw.normal(size=count),
            blocks=np.arange(count) // 40,
            columns=true + noise,
            noise=0.02 * draw.normal(size=true.shape),
        )
    )
    assert sum(fit.constants.values()) == pytest.approx(2.0, rel=1e-3)
    assert all(0.8 < value < 1.2 for value in fit.constants.values())
    assert any("little but noise" in line for line in fit.warnings)


@pytest.mark.parametrize("swapped", [(), (0, 3), (0, 2)])
def test_rotors_that_a_flight_does_not_separate_have_common_constants(swapped):
    """Front rotors and rear rotors move together, and My has a small part of the yaw moment.

    Single constants are then 2e-5 and -1e-5 in place of 5e-6; those of swapped columns are refused.
    """
    draw, count = np.random.default_rng(0), 4000
    base, names = read_vehicle("5inch.yaml").racing, [f"k_q{i}" for i in (1, 2, 3, 4)]
    pairs = 2.2e6 + 1e5 * draw.normal(size=(count, 2))
    squares = pairs[:, [0, 0, 1, 1]] + 1e4 * draw.normal(size=(count, 4))
    columns = squares * [1.0, 1.0, -1.0, -1.0]
    measured = 5e-6 * columns.sum(axis=1) + 1.5e-5 * squares @ [1.0, -1.0, 1.0, -1.0]
    measured += 0.02 * draw.normal(size=count)
    order = np.arange(4)
    order[list(swapped)] = swapped[::-1]
    columns = squares[:, order] * [1.0, 1.0, -1.0, -1.0]
    zeros = {axis: np.zeros((count, len(n))) for axis, n in RACING_CONSTANTS.items()}
    samples = Samples(
        motion=None,
        regressors=zeros | {"My": columns},
        noise=zeros,
        measured=np.stack([0.0 * measured] * 4 + [measured, 0.0 * measured], axis=1),
        flight=np.zeros(count, int),
        time=np.arange(count) / 100.0,
        sample_rate=100.0,
    )
    common = replaced(base, dict.fromkeys(names, 5e-6))
    fit = fit_axes(samples, common, frozenset(names))[4]
    if swapped:
        with pytest.raises(InputError, match="negated or swapped"):
            check_signs([fit])
        return
    check_signs([fit])
    assert fit.condition == np.inf and fit.r_squared > 0.9
    assert all(fit.constants[name] > 0.0 for name in names)
    for name in ("k_q2", "k_q3"):
        assert fit.constants[name] == 5e-6
        assert any(x.startswith(name) and "does not tell the rotors" in x for x in fit.warnings)


def test_ground_time_is_trimmed(bebop, flights):
    log = flights[0]
    idle = np.array(log["actuators"])
    idle[:500], idle[-250:] = 2500.0, 2500.0
    idle[1000:1025] = 2500.0  # a dive, not a landing
    rows = airborne(log.with_signals(actuators=idle))
    assert not rows[:500].any() and not rows[-250:].any() and rows[500:-250].all()


@pytest.mark.slow
def test_the_nominal_model_explains_flights_of_a_real_drone(bebop, plain_flights):
    """Or of a simulated one with a residual that the nominal model lacks."""
    base = bebop.replace(**RACING_INERTIA)
    files = [str(path) for path in plain_flights]
    logs = read_logs(LogsConfig(files=files), plain_flights[0].parent)
    explained = [fit.r_squared for fit in fit_axes(samples_of(logs, base), base)]
    assert AXES[:5] == ("ax", "ay", "az", "Mx", "My")
    assert np.all(np.array(explained[:5]) >= [0.92, 0.94, 0.94, 0.52, 0.50]), explained
