import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.fitting import log_table
from quadjax.fitting.axes import fit_axes
from quadjax.fitting.config import LogsConfig, UnitsConfig
from quadjax.fitting.flight_log import log_of_columns, read_log, read_logs, write_log
from quadjax.fitting.motors import fit_battery
from quadjax.fitting.quantities import evenly
from quadjax.fitting.samples import airborne, prepare
from quadjax.vehicle.battery import BatteryConfig

from .conftest import refused
from .flights import first_seconds, simulated

PAPARAZZI = LogsConfig(format="paparazzi")


@pytest.fixture(scope="module")
def columns():
    return first_seconds(simulated(1, noise=1.0), 4.0)


def _write(tmp_path, columns, **changed):
    path = tmp_path / "flight.csv"
    write_log(path, columns | changed)
    return path


def _body_velocity(columns):
    """Independently of the reader, from the angles."""
    phi, theta, psi = (columns[f"att_{name}"] for name in ("phi", "theta", "psi"))
    vx, vy, vz = (columns[f"vel_{axis}"] for axis in "xyz")
    vx, vy = np.cos(psi) * vx + np.sin(psi) * vy, np.cos(psi) * vy - np.sin(psi) * vx
    vx, vz = np.cos(theta) * vx - np.sin(theta) * vz, np.sin(theta) * vx + np.cos(theta) * vz
    vy, vz = np.cos(phi) * vy + np.sin(phi) * vz, np.cos(phi) * vz - np.sin(phi) * vy
    return np.stack([vx, vy, vz], axis=1)


def test_paparazzi_log(tmp_path, columns):
    log = read_log(_write(tmp_path, columns), PAPARAZZI)
    assert log.name == "flight" and abs(log.sample_rate - 250.0) < 1e-6 and log.flying.all()
    np.testing.assert_allclose(log["body_velocity"], _body_velocity(columns), atol=1e-6)
    np.testing.assert_allclose(log["actuators"][:, 2], columns["rpm_obs_3"], rtol=1e-6)
    np.testing.assert_allclose(log["command"][:, 3], columns["rpm_ref_4"], rtol=1e-6)
    less_bias = columns["ekf_U2"] - columns["ekf_X11"]
    np.testing.assert_allclose(log["specific_force"][:, 1], less_bias, atol=1e-6)


def test_own_columns_units_and_frames(tmp_path, columns):
    """The same flight in g, deg, rad/s for propellers, z up and ENU reads as the same log."""
    expected = read_log(_write(tmp_path, columns), PAPARAZZI)
    flip = np.array([1.0, -1.0, -1.0])
    forces = [columns[f"ekf_U{i + 1}"] - columns[f"ekf_X1{i}"] for i in range(3)]
    place, velocity = (
        np.array([columns[f"{name}_y"], columns[f"{name}_x"], -columns[f"{name}_z"]])
        for name in ("pos", "vel")
    )
    quantities = {
        "time": [1e3 * columns["time"]],
        "rpm": [columns[f"rpm_obs_{i}"] * np.pi / 30.0 for i in range(1, 5)],
        "gyro": flip[:, None] * np.degrees([columns[f"rate_{x}"] for x in "pqr"]),
        "acceleration": flip[:, None] * forces / 9.80665,
        "world_velocity": velocity,
        "position": 100.0 * place,
        "quaternion": _quaternion_enu_flu(columns),
    }
    names = {q: [f"{q}{i}" for i in range(len(values))] for q, values in quantities.items()}
    other = {}
    for quantity, values in quantities.items():
        other |= dict(zip(names[quantity], values, strict=True))
    units = UnitsConfig(time="ms", rpm="rad/s", gyro="deg/s", acceleration="g", length="cm")
    frames = {"body_frame": "FLU", "world_frame": "ENU"}
    config = LogsConfig(format="plain", columns=names, units=units, **frames)
    write_log(tmp_path / "other.csv", other)
    log = read_log(tmp_path / "other.csv", config)
    assert not log.source["unchecked"]
    north = "world_velocity1"
    with pytest.raises(InputError, match=f"column '{north}' negated"):
        log_of_columns(other | {north: -other[north]}, config, "flight")
    for name in ("actuators", "rates", "specific_force", "body_velocity", "position", "attitude"):
        np.testing.assert_allclose(log[name], expected[name], rtol=1e-5, atol=1e-5)


def _quaternion_enu_flu(columns):
    angles = np.stack([columns[f"att_{name}"] for name in ("psi", "theta", "phi")], axis=1)
    ned_frd = Rotation.from_euler("ZYX", angles).as_matrix()
    swap = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    x, y, z, w = Rotation.from_matrix(swap @ ned_frd @ np.diag([1.0, -1.0, -1.0])).as_quat().T
    return w, x, y, z


def _poke(columns, name, row, value):
    changed = np.array(columns[name], float)
    changed[row] = value
    return {name: changed}


def _times(columns, factor, *names):
    return {name: factor * columns[name] for name in names}


BAD = {  # changed columns, and words of the line
    "nan": (lambda c: _poke(c, "rate_q", 10, np.nan), "row 12", "'rate_q'"),
    "time backwards": (lambda c: _poke(c, "time", 20, 0.0), "row 22", "backwards"),
    "time stands still": (
        lambda c: _poke(c, "time", 20, c["time"][19]),
        *("row 22", "'time'", "stands still"),
    ),
    "gap": (
        lambda c: {"time": c["time"] + 0.5 * (np.arange(len(c["time"])) > 99)},
        *("row 102", "'time'", "gap"),
    ),
    "rad/s as rpm": (
        lambda c: _times(c, np.pi / 30, *(f"rpm_obs_{i}" for i in range(1, 5))),
        *("row 2", "'rpm_obs_1'", "rad/s"),
    ),
    "deg as rad": (
        lambda c: _times(c, 180 / np.pi, "att_phi", "att_theta"),
        *("row", "'att_phi'", "logs.units.angle deg?"),
    ),
    "a spike": (lambda c: _poke(c, "ekf_U2", 8, 1e6), "row 10", "'ekf_U2'", "m/s^2"),
    "ms as s": (lambda c: _times(c, 1e3, "time"), "row 3", "'time'", "logs.units.time"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_values_are_one_line(tmp_path, columns, case):
    change, *words = BAD[case]
    refused(_write(tmp_path, columns, **change(columns)), "paparazzi", *words)


def test_bad_files_are_one_line(tmp_path, columns, monkeypatch):
    path = tmp_path / "flight.csv"
    text = _write(tmp_path, columns).read_text()
    lines = text.splitlines()
    for content, *words in (
        (text.replace("rpm_obs_3", "other", 1), "row 1", "'rpm_obs_3'", "missing"),
        ("", "is empty"),
        (lines[0] + "\n", "row 1", "'time'", "0 rows"),
        ("\n".join([*lines[:50], "", *lines[50:]]), "row 51", "'time'", "empty"),
        ("\n".join([*lines[:50], lines[50] + ",7", *lines[51:]]), "row 51", "'7'"),
        ("\n".join([*lines[:100], ""]), "row 100", "ends after"),
        (text.replace(lines[5].split(",")[6], "abc", 1), "row 6", "column", "'abc'"),
        (f"time,{lines[0]}\n" + "\n".join("0," + x for x in lines[1:]), "twice"),
    ):
        path.write_text(content)
        refused(path, "paparazzi", *words)
    monkeypatch.setattr(log_table, "MAX_BYTES", 10)
    refused(path, "paparazzi", "bytes, allowed: up to")


def test_a_last_row_without_a_line_break_is_left_out(tmp_path, columns):
    path = _write(tmp_path, columns)
    whole, text = read_log(path, PAPARAZZI), path.read_text()
    assert whole.source["left_out"] == []
    for cut in (1, 3, len(text.splitlines()[-1]) // 2):  # in the last number, and in an earlier one
        path.write_text(text[:-cut])
        log = read_log(path, PAPARAZZI)
        (line,) = log.source["left_out"]
        assert line == f"row {len(whole.time) + 1}, which may be cut: no line break ends it"
        np.testing.assert_array_equal(log["rates"], whole["rates"][:-1])


@pytest.mark.parametrize(
    "files", [["nowhere.csv"], [], [""], ["nowhere/*.csv"], ["/"], ["~nobody_here/x.csv"], ["a**b"]]
)
def test_missing_files_are_refused(tmp_path, files):
    with pytest.raises(InputError, match="logs.files"):
        read_logs(LogsConfig(files=files), tmp_path)


def test_uneven_sampling_is_made_even(tmp_path, columns):
    """A level drone that swings north and south, with little noise on everything else."""
    random, count = np.random.default_rng(0), len(columns["time"])
    time = columns["time"] + random.uniform(-0.3, 0.3, count) / 250.0
    noise = {name: 1e-6 * random.normal(size=count) for name in columns}
    moving = ("vel_", "pos_", "att_", "rate_", "ekf_")
    noisy = {n: x + (0.0 if n.startswith(moving) else columns[n]) for n, x in noise.items()}
    swing = {
        "time": time,
        "pos_x": -np.cos(3.0 * time) / 3.0,
        "vel_x": np.sin(3.0 * time),
        "ekf_U1": 3.0 * np.cos(3.0 * time),
        "ekf_U3": noise["ekf_U3"] - 9.81,
    }
    log = read_log(_write(tmp_path, noisy | swing), PAPARAZZI)
    assert np.ptp(np.diff(log.time)) < 1e-9
    np.testing.assert_allclose(log["body_velocity"][:, 0], np.sin(3.0 * log.time), atol=1e-4)


def test_commands_in_a_gap_are_the_last_ones():
    """Motion is interpolated; a command that comes later is not known yet."""
    time = np.array([0.0, 0.01, 0.02, 0.06, 0.07])
    even, flying, _ = evenly({"time": time, "rpm_command": time[:, None], "gyro": time[:, None]})
    np.testing.assert_allclose(even["time"], 0.01 * np.arange(8))
    held = [0.0, 0.01, 0.02, 0.02, 0.02, 0.02, 0.06, 0.07]
    np.testing.assert_allclose(even["rpm_command"][:, 0], held)
    np.testing.assert_allclose(even["gyro"], even["time"][:, None])
    assert not flying.any()


@pytest.mark.parametrize("measured", [True, False])
def test_no_sample_in_or_next_to_a_bridged_gap_is_in_flight(measured, columns):
    """The next ones are later where rotor speeds have to be simulated from the commands."""
    time = columns["time"]
    kept = (time < 1.5) | (time > 2.0)
    lost = {name: values[kept] for name, values in columns.items()}
    config = PAPARAZZI
    if not measured:
        motors = {f"u{i}": lost[f"rpm_ref_{i}"] / 12000.0 for i in range(1, 5)}
        names = {"rpm": [], "rpm_command": [], "motor_command": list(motors)}
        lost, config = lost | motors, config.replace(columns=names)
    with pytest.raises(InputError, match="a gap of 0.508 s .*logs.max_gap"):
        log_of_columns(lost, config, "flight")
    log = log_of_columns(lost, config.replace(max_gap=1.0), "flight")
    assert log.source["gaps"] == pytest.approx([0.508])
    after = 2.5 if not measured else 2.1
    left = log.time[~log.flying]
    assert abs(left[0] - 1.4) < 0.01 and abs(left[-1] - after) < 0.01
    assert np.ptp(np.diff(left)) < 1e-9


def test_constants_do_not_depend_on_a_bridged_gap(bebop):
    """Of a flight that lacks 1 s: of the whole one, within 2 standard errors, 3% and 1%."""
    columns = simulated(1)
    part = (columns["time"] < 3.0) | (columns["time"] > 4.0)
    logs = [
        log_of_columns(part, PAPARAZZI.replace(max_gap=2.0), "flight")
        for part in (columns, {name: values[part] for name, values in columns.items()})
    ]
    whole, bridged = (fit_axes(prepare([log], bebop, [airborne(log)]), bebop) for log in logs)
    for first, second in zip(whole, bridged, strict=True):
        for name, error in second.errors.items():
            change = second.constants[name] - first.constants[name]
            most = min(2.0 * error, 0.03 * abs(first.constants[name]))
            assert np.isinf(error) or abs(change) < most, name
    lags = [
        fit_battery([log], 7500.0, BatteryConfig().filled(11000.0), [airborne(log)], 0.1)[0]
        for log in logs
    ]
    taus = [lag.constants["tau"] for lag in lags]
    assert abs(taus[1] - taus[0]) < min(2.0 * lags[1].errors["tau"], 0.01 * taus[0])


def test_a_counter_of_32_bits_may_wrap(columns):
    """Time stamps in us from 2^32 us on begin at zero again."""
    config = PAPARAZZI.replace(units=UnitsConfig(time="us"))
    stamps = np.rint(1e6 * columns["time"]) + 2.0**32 - 2e6
    whole, wrapped = (
        log_of_columns(columns | {"time": time}, config, "flight")
        for time in (stamps, stamps % 2.0**32)
    )
    np.testing.assert_array_equal(wrapped.time, whole.time)
    np.testing.assert_array_equal(wrapped["rates"], whole["rates"])


def _with_unit(text):
    return text.replace("rate_p,", "Rate_P (rad/s),", 1)


TABLES = {  # changed text of a log, and words of the line
    "tabs": (lambda text: text.replace(",", "\t"), "row 1", "separated by tabs", "commas"),
    "semicolons": (
        lambda text: text.replace(",", ";").replace(".", ","),
        *("row 1", "separated by semicolons", "decimal point"),
    ),
    "spaces": (lambda text: text.replace(",", " "), "row 1", "separated by spaces"),
    "a unit in the name": (_with_unit, "'rate_p' is missing; there is 'Rate_P (rad/s)' (logs."),
}


@pytest.mark.parametrize("case", TABLES)
def test_tables_of_another_form_are_one_line(case, tmp_path, columns):
    change, *words = TABLES[case]
    path = _write(tmp_path, columns)
    path.write_text(change(path.read_text()))
    refused(path, "paparazzi", *words)


@pytest.mark.parametrize(
    ("change", "never"),
    [
        (lambda c: _poke(c, "time", 20, 0.0), "logs."),
        (lambda c: _poke(c, "time", 20, c["time"][19]), "logs."),
        (lambda c: _times(c, 1e5, "rate_p"), "; is "),
    ],
)
def test_no_key_is_named_that_would_change_nothing(change, never, columns):
    config = PAPARAZZI.replace(units=UnitsConfig(gyro="deg/s"))
    with pytest.raises(InputError) as caught:
        log_of_columns(columns | change(columns), config, "flight")
    assert never not in str(caught.value)
