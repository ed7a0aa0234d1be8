"""Logs of other autopilots: what is read, what is refused, and the constants that they give."""

import numpy as np
import pytest
import yaml

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.fitting.axes import fit_shared_constants
from quadjax.fitting.config import FitConfig, LogsConfig
from quadjax.fitting.fit import fit
from quadjax.fitting.flight_log import log_of_columns, read_log
from quadjax.fitting.report import tables
from quadjax.fitting.samples import prepare
from quadjax.vehicle.constants import replaced, values_of
from quadjax.vehicle.vehicle_file import read_vehicle, write_vehicle
from tests.commands import run

from . import racing_logs
from .conftest import REPOSITORY, refused

ROTOR_ORDER = (1, 2, 3, 4)  # front-left, front-right, rear-right, rear-left: that of the logs


def _truth(drone):
    return racing_logs.constants(REPOSITORY / f"configs/vehicles/{drone}.yaml")


@pytest.fixture(scope="module")
def short():
    return racing_logs.fly(_truth("5inch"), seed=2, seconds=5.0)


def _write(form, flight, folder, variant):
    """A log of a flight in a format, in one of its two variants of frames."""
    path = folder / ("flight.ulg" if form == "ulog" else "flight.csv")
    if form == "blackbox":
        racing_logs.write_blackbox(path, racing_logs.blackbox_columns(flight, flu=variant))
    elif form == "tii":
        racing_logs.write_tii(path, racing_logs.tii_columns(flight, by_rows=variant))
    else:
        pytest.importorskip("pyulog", reason="ULog files need pyulog, the extra px4")
        racing_logs.write_ulog(path, flight, racing_logs.ulog_topics(flight))
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "drone"), [("blackbox", "5inch"), ("tii", "3inch"), ("ulog", "5inch")]
)
def test_every_constant_is_recovered(form, drone, tmp_path):
    """Within 2% from a base vehicle that is 30% off, or named as not determined."""
    flight = racing_logs.fly(_truth(drone), seed=1, seconds=14.0)
    path = _write(form, flight, tmp_path, variant=drone == "5inch")
    base = read_vehicle(f"{drone}.yaml").racing
    known = ("g", "w_max", "k", *(f"turning{i}" for i in ROTOR_ORDER))
    true = values_of(base)
    names = [name for name in true if name not in known]
    wrong = replaced(base, {name: 1.3 * true[name] for name in names} | {"k": 0.5})
    if form != "tii":
        wrong = wrong.replace(w_max=1.3 * base.w_max)
    vehicle = _vehicle(tmp_path, drone, **values_of(wrong))
    config = FitConfig(vehicle=vehicle, logs={"files": [str(path)], "format": form})
    result = fit(config)
    assert not result.logs[0].source["unchecked"]
    named = [line.partition(":")[0].partition(" ")[0] for line in result.warnings]
    assert named == [] if form != "tii" else "w_max" in named
    for name in [*names, "w_max", "k"]:
        np.testing.assert_allclose(values_of(result.fitted.constants)[name], true[name], 0.02)


@pytest.mark.parametrize(
    ("form", "variant"),
    [("blackbox", True), ("blackbox", False), ("tii", True), ("tii", False), ("ulog", True)],
)
def test_a_log_is_the_flight_in_our_units_and_frames(form, variant, short, tmp_path):
    log = read_log(_write(form, short, tmp_path, variant), LogsConfig(format=form))
    count = len(log.time)
    most = 60 if form == "ulog" else 10  # the last position is 0.1 s before the end
    assert abs(count - len(short["time"])) < most
    assert ("actuators" in log.signals) == (form != "tii")
    body = short["attitude"].inv().apply(short["velocity"])[:count]
    np.testing.assert_allclose(log["body_velocity"], body, atol=0.05)
    np.testing.assert_allclose(log["rates"], short["gyro"][:count], atol=0.02)
    assert (log.rotation.inv() * short["attitude"][:count]).magnitude().max() < 0.02
    np.testing.assert_allclose(log["specific_force"], short["force"][:count], atol=1.2)
    np.testing.assert_allclose(log["position"], short["position"][:count], atol=0.03)
    np.testing.assert_allclose(log["motor_command"], short["command"][:count], atol=5e-4)
    if form != "tii":
        np.testing.assert_allclose(log["actuators"], short["speed"][:count] * 30 / np.pi, atol=6.0)


def test_constants_common_to_the_rotors_take_the_place_of_the_base_vehicle(short, tmp_path):
    """So that a rotor without evidence is not that of a drone of another size."""
    path = _write("blackbox", short, tmp_path, variant=False)
    log = read_log(path, LogsConfig(format="blackbox"))
    own, other = (read_vehicle(f"{drone}.yaml").racing for drone in ("5inch", "3inch"))
    shared = fit_shared_constants(prepare([log], other, [log.flying]))
    for name in ("k_p", "k_q", "k_r", "k_rd"):
        values = [shared[f"{name}{rotor}"] for rotor in (1, 2, 3, 4)]
        mean = np.mean(getattr(own, name).components())
        assert len(set(values)) == 1 and 0.6 < values[0] / mean < 1.4, name


def _times(columns, factor, *names):
    return {name: factor * columns[name] for name in names}


BAD = {  # changed columns, and a word of the line
    "a gap": (lambda c: {"time": c["time"] + 400_000 * (np.arange(len(c["time"])) > 99)}, "a gap"),
    "a turned accelerometer": (
        lambda c: _times(c, -1, "accSmooth[0]", "accSmooth[1]"),
        "columns 'accSmooth[0]', 'accSmooth[1]' negated",
    ),
    "rotors in rpm": (
        lambda c: _times(c, 9.5493, *(f"omega[{i}]" for i in range(4))),
        "'omega[3]'",
    ),
    "swapped commands": (
        lambda c: {"motor[0]": c["motor[1]"], "motor[1]": c["motor[0]"]},
        "motor[",
    ),
    "no number": (lambda c: _poke(c, "omega[2]", "-"), "row 15, column"),
    "nan": (lambda c: _poke(c, "omega[2]", "nan"), "row 15, column"),
    "time backwards": (lambda c: _poke(c, "time", 0), "row 15, column"),
    "beyond the motors' range": (
        lambda c: {f"motor[{i}]": c[f"motor[{i}]"] + 1900 for i in range(4)},
        "logs.motor_range",
    ),
}


def _poke(columns, name, value):
    """Three rows of settings and the header precede the first sample, in row 5."""
    changed = columns[name].astype(object)
    changed[10] = value
    return {name: changed}


@pytest.mark.parametrize("case", BAD)
def test_bad_blackbox_columns_are_one_line(case, short, tmp_path):
    change, word = BAD[case]
    columns = racing_logs.blackbox_columns(short)
    racing_logs.write_blackbox(tmp_path / "bad.csv", columns | change(columns))
    refused(tmp_path / "bad.csv", "blackbox", word)


def test_a_log_that_is_too_slow_to_fit_names_its_file_and_rate(short, tmp_path):
    """It can be read: 25 Hz are no fault of a replay."""
    path = tmp_path / "slow.csv"
    part = {name: values[::20] for name, values in short.items()}
    racing_logs.write_blackbox(path, racing_logs.blackbox_columns(part))
    logs = {"files": [str(path)], "format": "blackbox"}
    with pytest.raises(InputError, match=r"slow.csv: a sample rate of 25 Hz .* above 32 Hz"):
        fit(FitConfig(vehicle="5inch.yaml", logs=logs))


def test_settings_of_the_log_scale_its_columns(short, tmp_path):
    columns = racing_logs.blackbox_columns(short)
    expected = tmp_path / "flight.csv"
    racing_logs.write_blackbox(expected, columns)
    fine = {f"gyroADC[{i}]": columns[f"gyroADC[{i}]"] * 10 for i in range(3)}
    fine |= {f"accSmooth[{i}]": columns[f"accSmooth[{i}]"] * 2 for i in range(3)}
    fine |= {f"motor[{i}]": columns[f"motor[{i}]"] + 842 for i in range(4)}
    settings = {"blackbox_high_resolution": 1, "acc_1G": 4096, "motorOutput": "[1000,2890]"}
    other = tmp_path / "other.csv"
    racing_logs.write_blackbox(other, columns | fine, settings)
    first, second = (read_log(path, LogsConfig(format="blackbox")) for path in (expected, other))
    for name in ("rates", "specific_force", "motor_command"):
        np.testing.assert_allclose(first[name], second[name], atol=1e-9)


def test_settings_and_matrices_that_cannot_be_used_are_one_line(short, tmp_path):
    path, columns = tmp_path / "bad.csv", racing_logs.blackbox_columns(short)
    for name, value in (
        ("acc_1G", "abc"),
        ("motorOutput", "2048,158"),
        ("blackbox_high_resolution", -1),
    ):
        racing_logs.write_blackbox(path, columns, {name: value})
        refused(path, "blackbox", f"setting {name} is ", "allowed: ")
    # With 512 counts of 1 g, 2048 would give a quarter of the force.
    racing_logs.write_blackbox(path, columns)
    path.write_text(path.read_text().replace("acc_1G,2048", "other,2048"))
    refused(path, "blackbox", "no setting acc_1G", "acc_1G,2048")
    columns = racing_logs.tii_columns(short)
    for name in (f"drone_rot[{i}]" for i in range(9)):
        columns[name] = np.where(np.arange(len(columns[name])) == 700, -1.0, 1.0) * columns[name]
    racing_logs.write_tii(path, columns)
    refused(path, "tii", "row 702, column 'drone_rot[0]' and on: ", "of -1, expected 1")


@pytest.mark.parametrize(
    ("form", "names_only"),
    [("blackbox", False), ("blackbox", True), ("tii", False), ("ulog", False)],
)
def test_two_logs_in_one_file_are_refused(form, names_only, short, tmp_path):
    path = _write(form, short, tmp_path, variant=False)
    log = path.read_bytes()
    head, lines = b"", log.splitlines(keepends=True)
    if names_only:
        head = log[: log.index(next(line for line in lines if b"gyroADC" in line))]
    path.write_bytes(log + log.removeprefix(head))
    says = "two ULog files in one"
    if form != "ulog":
        says = f"row {len(lines) + 1} begins another log, expected one log in a file: split it"
    refused(path, form, says)


def test_topics_of_a_ulog_file_are_checked(short, tmp_path):
    pytest.importorskip("pyulog", reason="ULog files need pyulog, the extra px4")
    path, topics = tmp_path / "flight.ulg", racing_logs.ulog_topics(short)
    gyro, position = short["gyro"].copy(), topics["vehicle_local_position"][1]
    gyro[20, 1] = np.nan
    down = {"accelerometer_m_s2": short["force"] * [1, 1, -1]}
    for topic, changed, *words in (
        ("vehicle_angular_velocity", (500, {"xyz": gyro}), "sample 20, column 'xyz[1]' is nan"),
        ("vehicle_attitude", (10, topics["vehicle_attitude"][1]), "sample ", ": a gap of 0.1"),
        ("vehicle_local_position", (7, position), "vehicle_local_position, ", ": a gap"),
        ("actuator_motors", (10, topics["actuator_motors"][1]), "motors, ", "SDLOG_PROFILE=17"),
        ("sensor_combined", (250, down), "accelerometer_m_s2[2]"),
        ("vehicle_local_position", (10, position | {"z": -position["z"]}), "z' negated"),
        ("vehicle_angular_velocity", None, "no topic vehicle_angular_velocity"),
        ("sensor_combined", None, "column 'accelerometer_m_s2[0]' is missing"),
    ):
        present = {k: v for k, v in (topics | {topic: changed}).items() if v is not None}
        racing_logs.write_ulog(path, short, present)
        refused(path, "ulog", *words)
    path.write_bytes(path.read_bytes()[:-1000][16:])
    refused(path, "ulog", "is binary data, expected a ULog file of PX4")


SPEEDS = [f"omega[{i}]" for i in range(4)]
SPEED_UNITS = {  # of the columns: rpm of 1, and the keys that say so
    "krpm": (1e3, {"units": {"rpm": "krpm"}}),
    "Hz": (60.0, {"units": {"rpm": "Hz"}}),
    "erpm": (1.0 / 7.0, {"units": {"rpm": "erpm"}, "pole_pairs": 7}),
    "hundreds": (100.0 / 6.0, {"units": {"rpm": "erpm/100"}, "pole_pairs": 6}),
    "a number": (12.5, {"units": {"rpm": 12.5}}),
}


@pytest.mark.parametrize("name", SPEED_UNITS)
def test_rotor_speeds_in_other_units(name, short):
    factor, keys = SPEED_UNITS[name]
    columns, rpm = _speeds_in(short, factor)
    log = log_of_columns(columns, LogsConfig(format="blackbox", **keys), "flight")
    np.testing.assert_allclose(log["actuators"], rpm[:, _OF_FORMAT], rtol=1e-9)


_OF_FORMAT = [3, 1, 0, 2]


def _speeds_in(flight, rpm_of_1):
    """Blackbox columns with speeds in a unit, and the speeds (n, 4), rpm."""
    columns = {n: 1.0 * x for n, x in racing_logs.blackbox_columns(flight).items()}
    rpm = np.stack([columns[name] for name in SPEEDS], axis=1) * 30.0 / np.pi
    for i in range(3):
        columns[f"accSmooth[{i}]"] = columns[f"accSmooth[{i}]"] / 2048.0
    return columns | dict(zip(SPEEDS, rpm.T / rpm_of_1, strict=True)), rpm


@pytest.mark.parametrize(
    ("rpm_of_1", "unit", "words", "never"),
    [
        (60.0, "rad/s", ("Hz",), ("rad/s", "erpm (")),
        (100.0 / 7.0, "rpm", ("rad/s or Hz or erpm/100 (with logs.pole_pairs)",), ("erpm (",)),
        (1.0 / 7.0, "rpm", ("is logs.units.rpm erpm (with logs.pole_pairs) or",), ("Hz", "rad/s")),
        (1e6, "rpm", ("is logs.units.rpm the rpm of 1?",), ("Hz",)),
    ],
)
def test_a_unit_of_speeds_is_hinted_only_where_it_would_do(rpm_of_1, unit, words, never, short):
    config = LogsConfig(format="blackbox", units={"rpm": unit})
    with pytest.raises(InputError) as caught:
        log_of_columns(_speeds_in(short, rpm_of_1)[0], config, "flight")
    line = str(caught.value)
    assert all(word in line for word in words) and not any(word in line for word in never), line


def test_electrical_speeds_of_betaflight_need_the_poles_of_the_motors(short, tmp_path):
    """In hundreds, by the head of the file or by the config."""
    columns, path = racing_logs.blackbox_columns(short), tmp_path / "flight.csv"
    for i in range(4):
        rpm = columns.pop(f"omega[{i}]") * 30.0 / np.pi
        columns[f"eRPM[{i}]"] = np.rint(0.07 * rpm).astype(int)
    racing_logs.write_blackbox(path, columns, {"motor_poles": 14})
    config, speeds = LogsConfig(format="blackbox"), short["speed"] * 30.0 / np.pi
    np.testing.assert_allclose(read_log(path, config)["actuators"], speeds, atol=15.0)
    racing_logs.write_blackbox(path, columns)
    refused(path, "blackbox", "'eRPM[0]'", "electrical", "logs.pole_pairs is null", "motor_poles")
    log = read_log(path, config.replace(pole_pairs=7))
    np.testing.assert_allclose(log["actuators"], speeds, atol=15.0)


@pytest.mark.parametrize(("form", "why"), [("blackbox", "in rad/s"), ("tii", "no rotor speeds")])
def test_pole_pairs_of_other_speeds_or_of_none_are_refused(form, why, short, tmp_path):
    path = _write(form, short, tmp_path, False)
    with pytest.raises(InputError, match=f"logs.pole_pairs is 7, which has no effect: .* {why}"):
        read_log(path, LogsConfig(format=form, pole_pairs=7))


@pytest.mark.parametrize("second", ["gyro2_x", "gyro_x_1", "drone_rot2[0]"])
def test_columns_of_a_second_sensor_are_named(second, short, tmp_path):
    """An element with another index, or another name, is none."""
    columns, path = racing_logs.tii_columns(short), tmp_path / "flight.csv"
    more = dict.fromkeys((second, "drone_rot[9]", "gyro_temperature"), columns["elapsed_time"])
    racing_logs.write_tii(path, columns | more)
    assert read_log(path, LogsConfig(format="tii")).source["left_out"] == [second]


@pytest.mark.parametrize("name", ["motor", "omega"])
def test_drones_of_more_than_four_motors_are_refused(name, short, tmp_path):
    """Unless the config lists four of them, which is said; unused columns do not change."""
    columns, path = racing_logs.blackbox_columns(short), tmp_path / "flight.csv"
    still = {f"{name}[{i}]": np.full_like(columns["time"], 1000) for i in (4, 5)}
    racing_logs.write_blackbox(path, columns | still)
    assert read_log(path, LogsConfig(format="blackbox")).source["left_out"] == []
    racing_logs.write_blackbox(
        path, columns | {f"{name}[{i + 4}]": columns[f"{name}[{i}]"] for i in range(2)}
    )
    refused(path, "blackbox", f"columns '{name}[4]', '{name}[5]'", "more than four motors")
    quantity = {"motor": "motor_command", "omega": "rpm"}[name]
    four = {quantity: [f"{name}[{i}]" for i in _OF_FORMAT]}
    log = read_log(path, LogsConfig(format="blackbox", columns=four))
    assert log.source["left_out"] == [f"{name}[4]", f"{name}[5]"]


@pytest.fixture
def ulog(short, tmp_path):
    """A function that writes and reads a ULog file of some topics with other instances or times."""
    pytest.importorskip("pyulog", reason="ULog files need pyulog, the extra px4")

    def read(changed, max_gap=0.05, **options):
        topics = {k: v for k, v in (racing_logs.ulog_topics(short) | changed).items() if v}
        racing_logs.write_ulog(tmp_path / "flight.ulg", short, topics, **options)
        return read_log(tmp_path / "flight.ulg", LogsConfig(format="ulog", max_gap=max_gap))

    return read


def test_commands_of_a_disarmed_px4_are_trimmed(ulog, short):
    rate, fields = racing_logs.ulog_topics(short)["actuator_motors"]
    control = fields["control"].copy()
    control[:100] = control[-200:] = np.nan
    whole, log = ulog({}), ulog({"actuator_motors": (rate, {"control": control})})
    assert len(whole.time) - len(log.time) == pytest.approx(300, abs=55)
    np.testing.assert_allclose(log["motor_command"][0], whole["motor_command"][100])
    control[1000] = np.nan
    with pytest.raises(InputError, match=r"sample 900, column 'control\[2\]' is nan"):
        ulog({"actuator_motors": (rate, {"control": control})})


def test_slow_telemetry_of_px4_is_left_out(ulog, short):
    """Speed controllers that report at 4 Hz: the motors are fitted by their effect."""
    _, fields = racing_logs.ulog_topics(short)["esc_status"]
    log = ulog({"esc_status": (4, fields)})
    assert "actuators" not in log.signals and "motor_command" in log.signals
    assert log.source["left_out"] == ["topic esc_status (a sample every 0.25 s, allowed: 0.05 s)"]


def test_a_dropout_of_a_topic_is_a_gap_of_the_log(ulog):
    """Of 120 ms; a first sample of 0.2 s before the others is no gap."""
    lost = {"lost": {"sensor_combined": (2.0, 2.12)}}
    with pytest.raises(InputError) as caught:
        ulog({}, **lost)
    line = str(caught.value)
    assert "a gap of 0.12" in line and "in topic sensor_combined (logs.max_gap)" in line
    log = ulog({}, 0.2, **lost)
    assert log.source["gaps"] == pytest.approx([0.124], abs=0.005)
    assert not log.flying[(log.time > 1.95) & (log.time < 2.15)].any()
    late = ulog({}, lost={"vehicle_attitude": (0.003, 0.2)})
    assert not late.source["gaps"] and late.flying.all()


def test_other_instances_of_a_topic_are_read_or_named(ulog):
    whole = ulog({})
    only = ulog({}, instances={"sensor_combined": [1]})
    np.testing.assert_array_equal(only["specific_force"], whole["specific_force"])
    both = ulog({}, instances={"vehicle_angular_velocity": [0, 2]})
    np.testing.assert_array_equal(both["rates"], whole["rates"])
    assert both.source["left_out"] == ["topic vehicle_angular_velocity, instance 2"]


def test_a_ulog_file_that_is_cut_says_how_much_was_read(ulog, short, tmp_path):
    path, config = tmp_path / "flight.ulg", LogsConfig(format="ulog")
    assert ulog({}).source["left_out"] == []
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    log = read_log(path, config)
    expected = f"the end of the file, whose last message is cut, after {log.time[-1]:.3g} s"
    assert log.source["left_out"] == [expected] and 2.0 < log.time[-1] < 2.6
    result = fit(FitConfig(vehicle="5inch.yaml", logs={"files": [str(path)], "format": "ulog"}))
    assert f"flight: not read: {expected}" in result.warnings


@pytest.mark.parametrize("topic", ["actuator_motors", "esc_status"])
def test_six_motors_of_px4_are_refused(topic, ulog, short):
    rate, fields = racing_logs.ulog_topics(short)[topic]
    if topic == "esc_status":
        fields = fields | {f"esc[{i}].esc_rpm": fields["esc[0].esc_rpm"] for i in (4, 5)}
    else:
        control = fields["control"].copy()
        control[:, 4:6] = control[:, :2]
        fields = {"control": control}
    with pytest.raises(InputError, match=r"\[4\].*\[5\].* of more than four motors"):
        ulog({topic: (rate, fields)})


def test_a_ulog_file_without_motors_names_the_topics(ulog):
    with pytest.raises(InputError, match="no topic actuator_motors or esc_status"):
        ulog({"actuator_motors": None, "esc_status": None})


@pytest.fixture(scope="module")
def pieces(short, tmp_path_factory):
    """Two flights, and a part of the first, as logs without rotor speeds (tii) and with them."""
    folder = tmp_path_factory.mktemp("pieces")
    for name, rows in {"a": slice(0, 1250), "b": slice(1250, 2500), "c": slice(0, 1150)}.items():
        part = {key: values[rows] for key, values in short.items()}
        racing_logs.write_tii(folder / f"{name}_tii.csv", racing_logs.tii_columns(part))
        racing_logs.write_blackbox(
            folder / f"{name}_blackbox.csv", racing_logs.blackbox_columns(part)
        )
    return folder


def _vehicle(folder, drone, **values):
    """The file of a base vehicle with other constants of the racing model."""
    vehicle, path = read_vehicle(f"{drone}.yaml"), folder / "base.yaml"
    constants = replaced(vehicle.racing, values)
    write_vehicle(path, vehicle.with_constants("racing", constants), "a base")
    return str(path)


def _fit(pieces, form, names, **changes):
    files = [str(pieces / f"{name}_{form}.csv") for name in names]
    logs = {"files": files, "format": form, "min_seconds": 1.0}
    vehicle = _vehicle(pieces, "5inch", tau=0.04, k=0.4)
    return fit(FitConfig(vehicle=vehicle, logs=logs, **changes))


@pytest.mark.parametrize(
    ("drone", "rpm_of_1", "start", "hint"),
    [
        ("5inch", 1.5 * 30.0 / np.pi, "k_w is 0.44", "rad/s"),
        ("3inch", "rad/s", "k_w is 39", "Hz"),  # the speeds are written in Hz
    ],
)
def test_the_unit_that_the_thrust_of_the_base_vehicle_suggests(
    drone, rpm_of_1, start, hint, tmp_path
):
    columns = racing_logs.blackbox_columns(racing_logs.fly(_truth(drone), seed=2, seconds=3.0))
    in_hz = 1.0 / (2.0 * np.pi) if drone == "3inch" else 1.0
    columns |= {name: in_hz * columns[name] for name in SPEEDS}
    racing_logs.write_blackbox(tmp_path / "flight.csv", columns)
    logs = {"files": [str(tmp_path / "flight.csv")], "format": "blackbox", "min_seconds": 1.0}
    logs["units"] = {"rpm": rpm_of_1}
    result = fit(FitConfig(vehicle=f"{drone}.yaml", logs=logs))
    (line,) = (line for line in result.warnings if "logs.units.rpm" in line)
    assert line.startswith(start) and drone[0] in line
    assert line.endswith(f"is logs.units.rpm {hint} or the rpm of 1?")


@pytest.mark.parametrize("form", [pytest.param("tii", marks=pytest.mark.slow), "blackbox"])
def test_a_held_out_flight_has_no_influence_on_its_prediction(form, pieces):
    """Motors, rotor speeds and regressors are those of the fit to the other flights alone."""
    both = _fit(pieces, form, "ab")
    assert {part.name for part in both.held_out} == {f"a_{form}", f"b_{form}"}
    shorter = _fit(pieces, form, "cb")
    without_a, without_c = both.without[f"a_{form}"], shorter.without[f"c_{form}"]
    assert without_a.constants == without_c.constants
    assert shorter.fitted.constants != both.fitted.constants
    assert "held out: R^2 of each flight by a fit without it" in tables(both)


@pytest.mark.slow
def test_no_key_of_the_base_vehicle_is_lost_in_the_file_for_training(pieces, tmp_path):
    text = (REPOSITORY / "configs/vehicles/5inch.yaml").read_text()
    others = "motor: {k_x: 1.5e-05}\nmass: 0.7\nwidth: 0.3\nfitted_speed: 28.0\n"
    (tmp_path / "base.yaml").write_text(others + text)
    logs = f"logs.files=[{pieces}/?_blackbox.csv]"
    place = [f"vehicle={tmp_path}/base.yaml", "--output", tmp_path, "--name", "mine"]
    assert run("fit", "blackbox", logs, "split.by=time", *place) == 0
    report = (tmp_path / "mine/report.txt").read_text()
    assert "held out: R^2 of the last part of each flight" in report
    written = yaml.safe_load((tmp_path / "mine/vehicle.yaml").read_text())
    assert (written["mass"], written["motor"]) == (0.7, {"k_x": 1.5e-05})
    assert written["width"] == 0.3 and 1.0 < written["fitted_speed"] < 20.0  # of these flights
    assert written["racing"]["turning"] == ["cw", "ccw", "cw", "ccw"]
    config = load_config("e2e +fastest", [f"vehicle={tmp_path}/mine/vehicle.yaml"])
    assert abs(config.vehicle.constants["k_w"] / 2.49e-6 - 1.0) < 0.02


def test_a_drone_without_measured_speeds_needs_the_racing_model(short, tmp_path, capsys):
    path = _write("tii", short, tmp_path, variant=True)
    arguments = [f"logs.files=[{path}]", "vehicle=bebop1.yaml", "body.inertia=base"]
    assert run("fit", "tii", *arguments, "--output", tmp_path) == 2
    assert "no columns for rpm (logs.columns.rpm)" in capsys.readouterr().err
