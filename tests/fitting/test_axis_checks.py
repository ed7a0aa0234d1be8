"""Faults of a log's columns, each refused in one line."""

import itertools

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.flight_log import log_of_columns
from quadjax.fitting.formats import FORMATS, PAPARAZZI, PLAIN

from .conftest import FLIGHTS
from .flights import first_seconds, hover, simulated

VECTORS = ("gyro", "acceleration", "body_velocity", "world_velocity", "position", "euler")


def faults(columns, form):
    """Every fault by its name: the changed columns."""
    names = {q: names for q, names in FORMATS[form].columns.items() if names[0] in columns}
    vectors = [names[quantity] for quantity in VECTORS if quantity in names]
    found = {f"-{name}": {name: -columns[name]} for group in vectors for name in group}
    motors = names["rpm"]
    found |= {f"-{name}": {name: -columns[name]} for name in motors}
    swaps = [*vectors, motors, names.get("rpm_command", [])]
    for a, b in (pair for group in swaps for pair in itertools.combinations(group, 2)):
        found[f"{a} <-> {b}"] = {a: columns[b], b: columns[a]}
    for label, order in {"mirrored": (1, 0, 3, 2), "turned": (1, 2, 3, 0)}.items():
        found[f"motors {label}"] = {motors[i]: columns[motors[k]] for i, k in enumerate(order)}
    for name in itertools.chain(motors, *vectors):
        found[f"{name} constant"] = {name: np.full_like(columns[name], columns[name].mean())}
    rate = 1.0 / np.median(np.diff(columns[names["time"][0]]))
    for group in (*vectors, motors):
        for seconds in (0.1, 0.3, 0.5):
            found[f"{group} late {seconds}"] = {
                name: delayed(columns[name], round(seconds * rate)) for name in group
            }
    for group in (group for group in vectors if group != names.get("euler")):
        found[f"{group} turned"] = turned(columns, *group[:2], np.radians(45.0))
        for factor in (0.5, 1.5):
            found[f"{group} x {factor}"] = {name: factor * columns[name] for name in group}
    for name in motors:
        found[f"{name} x 1.5"] = {name: 1.5 * columns[name]}
    return found


def delayed(values, count):
    return np.concatenate([np.repeat(values[:1], count), values[:-count]])


def turned(columns, a, b, angle):
    cosine, sine = np.cos(angle), np.sin(angle)
    return {
        a: cosine * columns[a] - sine * columns[b],
        b: sine * columns[a] + cosine * columns[b],
    }


def without_attitude(log):
    """The columns of a log that has no attitude and no position."""
    plain, names = {"t": log.time}, ("rpm", "gyro", "acceleration", "body_velocity")
    signals = ("actuators", "rates", "specific_force", "body_velocity")
    for name, signal in zip(names, signals, strict=True):
        plain |= dict(zip(PLAIN[name], log[signal].T, strict=True))
    return plain


def unrelated(columns, form):
    """Every column of a vector of another time of the flight, backward."""
    names = (FORMATS[form].columns.get(quantity, ()) for quantity in VECTORS)
    return {
        f"{name} of something else": {name: np.roll(columns[name][::-1], len(columns[name]) // 3)}
        for name in itertools.chain(*names)
        if name in columns
    }


def accepted(columns, form, title, faults=faults):
    """Faults that are not refused, with what is reported as not checked; prints every answer."""
    config, missed = LogsConfig(format=form), {}
    print(f"\n{title}")
    for name, changed in faults(columns, form).items():
        try:
            log = log_of_columns(columns | changed, config, title)
        except InputError as error:
            line = str(error)
            assert "\n" not in line and line.startswith(title)
            assert any(repr(column) in line for column in columns)
        else:
            missed[name] = " ".join(log.source["unchecked"])
            line = f"accepted; not checked: {missed[name]}"
        print(f"  {name:24} {line.removeprefix(title + ': ')}")
    return missed


RESIDUAL = (5, 0.7, (0.008, 0.008, 0.003))


@pytest.fixture(scope="module")
def flown():
    return first_seconds(simulated(1, RESIDUAL, 1.0), 4.0)


@pytest.mark.slow
def test_every_fault_of_a_short_flight_is_refused(flown):
    assert accepted(flown, "paparazzi", "flight") == {}
    assert log_of_columns(flown, LogsConfig(format="paparazzi"), "flight").source["unchecked"] == []
    assert len(faults(flown, "paparazzi")) > 60


def columns_of_file(path):
    header = path.open().readline().strip().split(",")
    return dict(zip(header, np.loadtxt(path, delimiter=",", skiprows=1).T, strict=True))


each_flight = pytest.mark.parametrize(
    "path", sorted(FLIGHTS.glob("*.csv")), ids=lambda path: path.stem
)


@pytest.mark.slow
@each_flight
def test_columns_of_something_else_are_refused(path):
    """But for up to three of 15, with small forces, a steady height, or angles."""
    missed = accepted(columns_of_file(path), "plain", "flight", unrelated)
    assert len(missed) <= 3
    assert {name.split()[0] for name in missed} <= {"ax", "vbx", "z", "phi", "theta"}


@pytest.mark.slow
@each_flight
def test_faults_of_a_real_flight_are_refused(path):
    """Every fault on one of the four flights, but for what a steady flight has no evidence of."""
    columns = columns_of_file(path)
    log_of_columns(columns, LogsConfig(), "flight")
    first = sorted(FLIGHTS.glob("*.csv")).index(path)

    def quarter(columns, form):
        return dict(itertools.islice(faults(columns, form).items(), first, None, 4))

    missed = accepted(columns, "plain", "flight", quarter)
    assert len(missed) <= 2
    for name, unchecked in missed.items():
        assert repr(name.split()[0].strip("-")) in unchecked


def late(columns, *names):
    return {name: delayed(columns[name], 50) for name in names}


def times(columns, factor, *names):
    return {name: factor * columns[name] for name in names}


LINES = {  # what the line says: the changed columns
    "columns 'rate_p', 'rate_q' swapped": lambda c: {"rate_p": c["rate_q"], "rate_q": c["rate_p"]},
    "columns 'rpm_obs_1', 'rpm_obs_3' swapped": lambda c: {
        f"rpm_obs_{i}": c[f"rpm_obs_{4 - i}"] for i in (1, 3)
    },
    "column 'vel_z' 97 times too large .*logs.units": lambda c: times(c, 100.0, "vel_z"),
    "columns 'pos_x', .* 956 times too large .*; is logs.units.length mm[?]": lambda c: times(
        c, 1000.0, *PAPARAZZI["position"]
    ),
    "columns 'ekf_U1', .* 9.* times too small .*; is logs.units.acceleration g[?] That": lambda c: (
        times(c, 1.0 / 9.81, *PAPARAZZI["acceleration"], *PAPARAZZI["acceleration_bias"])
    ),
    "column 'rate_q' 0.206 s late": lambda c: late(c, "rate_q"),
    "columns 'ekf_U1', 'ekf_U2' rotated by 45 deg": lambda c: turned(
        c, "ekf_U1", "ekf_U2", np.radians(45.0)
    ),
    "columns 'rpm_obs_1', .* 0.2 s late": lambda c: late(c, *PAPARAZZI["rpm"]),
    "columns 'rpm_ref_1', .* are 1.5.? times the speeds 'rpm_obs_1', .*logs.units.rpm": lambda c: (
        times(c, 1.5, *PAPARAZZI["rpm_command"])
    ),
    "column 'rpm_obs_3' is 1.53 times the other motors' speeds": lambda c: times(
        c, 1.5, "rpm_obs_3"
    ),
}


@pytest.mark.parametrize("message", LINES)
def test_the_line_names_the_columns_and_the_change(flown, message):
    with pytest.raises(InputError, match=message):
        log_of_columns(flown | LINES[message](flown), LogsConfig(format="paparazzi"), "flight")


def test_what_has_no_evidence_is_reported_and_noise_is_not_a_contradiction():
    config = LogsConfig(format="paparazzi")
    lines = log_of_columns(first_seconds(hover(), 4.0), config, "flight").source["unchecked"]
    assert "'rate_r'" in lines
    assert any("'rpm_obs_1'" in line for line in lines)
    log_of_columns(first_seconds(simulated(3, RESIDUAL, 5.0), 4.0), config, "flight")


@pytest.mark.slow
def test_every_fault_is_refused_without_attitude_and_position(flown):
    plain = without_attitude(log_of_columns(flown, LogsConfig(format="paparazzi"), "flight"))
    assert log_of_columns(plain, LogsConfig(), "flight").source["unchecked"] == []
    # The horizontal forces of this flight are too small to show how the accelerometer is turned.
    assert list(accepted(plain, "plain", "flight")) == ["['ax', 'ay', 'az'] turned"]


def test_the_allowed_errors_are_in_the_config(flown):
    late = {name: delayed(flown[name], 18) for name in PAPARAZZI["gyro"]}
    fast = {name: 1.5 * flown[name] for name in PAPARAZZI["gyro"]}
    aslant = turned(flown, "rate_p", "rate_q", np.radians(20.0))
    for wrong, key, value in (
        (late, "max_delay", 0.1),
        (fast, "max_scale_error", 0.6),
        (aslant, "max_angle", 30.0),
    ):
        with pytest.raises(InputError, match=f"logs.{key}"):
            log_of_columns(flown | wrong, LogsConfig(format="paparazzi"), "flight")
        allowing = LogsConfig(format="paparazzi", **{key: value})
        log_of_columns(flown | wrong, allowing, "flight")
