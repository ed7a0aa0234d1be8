"""The pilot alone: its clock of steps, what it reads, lost states and what loading leaves."""

import ctypes

import numpy as np
import pytest

from quadjax.export.targets import RUNTIME, calls_per_step
from quadjax.export.verify.build import VEHICLE, load_library
from quadjax.export.verify.toolchain import host
from quadjax.export.words import STATE_FIELDS, pack
from tests.export.support import fixed
from tests.export.test_runtime import FILES, at_of, edited, everything

PROBE = """
#include "qj_pilot.h"
static qj_pilot pilot;
const char *load(const int32_t *words, uint32_t bytes, uint32_t gives, uint32_t call_ns);
uint32_t step(uint32_t now_us, const qj_vehicle *vehicle, float *command);
void numbers(uint32_t *out);
void last_command(float *out);
void disturbance(float *out);
void start_at(const float *first, const float *positions, uint32_t count, uint32_t *out);
const char *load(const int32_t *words, uint32_t bytes, uint32_t gives, uint32_t call_ns) {
  const qj_interface interface = {gives, 14U, call_ns, 1U};
  return qj_pilot_load(&pilot, words, bytes, &interface);
}
uint32_t step(uint32_t now_us, const qj_vehicle *vehicle, float *command) {
  return (uint32_t)qj_pilot_step(&pilot, now_us, vehicle, command);
}
void numbers(uint32_t *out) {
  out[0] = pilot.counters.steps;
  out[1] = pilot.counters.nan_steps;
  out[2] = pilot.counters.late_calls;
  out[3] = pilot.race.target;
  out[4] = pilot.race.passed;
  out[5] = pilot.race.missed;
  out[6] = pilot.counters.estimator_calls;
}
void last_command(float *out) {
  for (uint32_t i = 0U; i < 4U; ++i) {
    out[i] = pilot.command[i];
  }
}
void disturbance(float *out) {
  for (uint32_t i = 0U; i < 3U; ++i) {
    out[i] = pilot.moment[i];
    out[3U + i] = pilot.force[i];
  }
}
void start_at(const float *first, const float *positions, uint32_t count, uint32_t *out) {
  qj_race_start(&pilot.policy, &pilot.race, first, 0U);
  for (uint32_t i = 0U; i < count; ++i) {
    out[i] = (uint32_t)qj_race_update(&pilot.policy, &pilot.race, positions + 3U * i);
  }
}
"""
FLYING, HELD, LOST = 1, 2, 3
NAMES = ("steps", "nan_steps", "late_calls", "target", "passed", "missed", "estimator_calls")
GIVEN = ("euler", "quaternion", "rotor_speed")


class Pilot:
    """The pilot with the words of a policy."""

    def __init__(self, library, words, call_ns, gives=GIVEN):
        self._library, self._words = library, np.frombuffer(words, np.int32).copy()
        library.load.restype = ctypes.c_char_p
        fields = (*STATE_FIELDS, *[""] * (15 - len(STATE_FIELDS)), "sensors")
        bits = sum(1 << (1 + fields.index(name)) for name in gives)
        pointer = self._words.ctypes.data_as(ctypes.c_void_p)
        self.wrong = library.load(pointer, len(words), bits, call_ns)
        self.state = np.zeros(1, VEHICLE)
        self.state["quaternion"] = [1, 0, 0, 0]

    def call(self, now_us, time_us=None):
        """Status and commands of a call; ``time_us`` of the state."""
        out = np.zeros(4, np.float32)
        self.state["time_us"] = (now_us if time_us is None else time_us) % 2**32
        pointers = [x.ctypes.data_as(ctypes.c_void_p) for x in (self.state, out)]
        return self._library.step(ctypes.c_uint32(now_us % 2**32), *pointers), out

    def numbers(self):
        out = np.zeros(len(NAMES), np.uint32)
        self._library.numbers(out.ctypes.data_as(ctypes.c_void_p))
        return dict(zip(NAMES, out.tolist(), strict=True))

    def read(self, name, size):
        out = np.zeros(size, np.float32)
        getattr(self._library, name)(out.ctypes.data_as(ctypes.c_void_p))
        return out

    def start_at(self, first, positions):
        out = np.zeros(len(positions), np.uint32)
        arrays = [np.asarray(x, np.float32) for x in (first, positions)]
        pointers = [x.ctypes.data_as(ctypes.c_void_p) for x in (*arrays, out)]
        self._library.start_at(*pointers[:2], len(out), pointers[2])
        return out.tolist()


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    folder = tmp_path_factory.mktemp("probe")
    (folder / "probe.c").write_text(PROBE)
    return load_library(host(), [*FILES, folder / "probe.c"], folder / "probe.so", [f"-I{RUNTIME}"])


def words_of(name="racing with a history", period_ns=None):
    words = pack(fixed(name)[1])
    return edited(words, {at_of(words, "header", "period_ns"): period_ns}) if period_ns else words


@pytest.mark.parametrize(
    ("rate", "period_ms", "expected"),
    [(2000, 10, 20), (1000, 20, 20), (1000, 10, 10), (512, 10, 5), (512, 20, 10), (100, 10, 1)],
)
def test_a_step_is_due_at_the_nearest_call(library, rate, period_ms, expected):
    pilot = Pilot(library, words_of(period_ns=period_ms * 1_000_000), round(1e9 / rate))
    assert not pilot.wrong and calls_per_step(rate, period_ms / 1e3) == expected
    start, steps = 2**32 - 5000, []  # the clock wraps around
    for call in range(3 * expected + 1):
        pilot.call(start + round(call * 1e6 / rate))
        steps.append(pilot.numbers()["steps"])
    assert np.flatnonzero(np.diff([0, *steps])).tolist() == [expected * i for i in range(4)]


@pytest.mark.parametrize("rate", [100, 500, 512, 1000, 2000])
def test_the_pilot_takes_the_steps_that_the_export_takes(library, rate):
    for period_us in (3000, 4000, 9800, 10_000, 10_500, 15_000, 19_500, 20_000, 33_333):
        pilot = Pilot(library, words_of(period_ns=period_us * 1000), round(1e9 / rate))
        assert bool(pilot.wrong) != bool(calls_per_step(rate, period_us / 1e6)), period_us


def test_steps_follow_the_calls_not_the_states(library):
    pilot = Pilot(library, words_of(), 10_000_000)
    for call in range(50):  # states of 250 Hz: 8 or 12 ms apart
        now = 1_000_000 + 10_000 * call
        assert pilot.call(now, now - now % 4000)[0] == FLYING
    assert pilot.numbers()["steps"] == 50


def test_a_state_newer_than_the_call_is_used(library):
    pilot = Pilot(library, words_of(), 10_000_000)
    assert pilot.call(1_000_000, 1_000_050)[0] == FLYING
    assert pilot.call(1_010_000, 1_010_050)[0] == FLYING
    assert pilot.numbers()["late_calls"] == 0


def test_a_state_of_the_far_future_is_not_used(library):
    pilot = Pilot(library, words_of(), 10_000_000)
    pilot.call(1_000_000)
    for ahead in (100_001, 2**30, 2**31 - 1):
        assert pilot.call(1_010_000, 1_010_000 + ahead)[0] == HELD
    assert pilot.call(1_020_000)[0] == FLYING  # the state of the future is not the newest one


def test_stale_and_repeated_states_hold_then_stop(library):
    pilot = Pilot(library, words_of(), 10_000_000)
    assert pilot.call(1_000_000, 899_999)[0] == LOST  # no race yet, and the state is 100 ms old
    pilot.call(1_000_000)
    status, flown = pilot.call(1_010_000)
    assert status == FLYING and np.all(flown != 0)
    for call in range(1, 12):
        status, held = pilot.call(1_010_000 + 10_000 * call, 1_010_000)  # the same state
        assert status == HELD
        np.testing.assert_array_equal(held, flown)
    status, stopped = pilot.call(1_130_000, 1_010_000)
    assert status == LOST and not stopped.any() and not pilot.read("last_command", 4).any()
    assert pilot.numbers()["late_calls"] == 13
    status, again = pilot.call(1_131_000)  # a step at the first new state
    assert status == FLYING and np.all(again != 0)


def test_what_is_not_given_is_not_read(library):
    words = words_of("published racing")
    for name in ("moment_ext", "force_ext", "rpm", "gyro", "specific_force", "body_velocity"):
        pilot = Pilot(library, words, 10_000_000)
        expected = pilot.call(1_000_000)[1]
        pilot = Pilot(library, words, 10_000_000)
        pilot.state[name] = np.nan
        np.testing.assert_array_equal(pilot.call(1_000_000)[1], expected)
        assert pilot.numbers()["nan_steps"] == 0 and not pilot.read("disturbance", 6).any()


def test_estimators_count_calls_with_wrong_measurements(library):
    given = (*GIVEN, "rpm", "sensors")
    made, words = everything()
    period = round(1e9 / made.estimator.sample_rate)
    pilot = Pilot(library, words, period, given)
    assert not pilot.wrong
    pilot.state["specific_force"] = [0, 0, -9.81]
    now, wrong = 0, 0
    for name, value in (("gyro", 0.1), ("gyro", np.nan), ("gyro", 0.1), ("rpm", 1e9), ("rpm", 5e3)):
        pilot.state[name] = value
        now += period // 1000
        assert pilot.call(now)[0] == FLYING
        wrong += not abs(value) < 1e6
        assert pilot.numbers()["estimator_calls"] == wrong
        assert np.isfinite(pilot.read("disturbance", 6)).all()
    assert pilot.read("disturbance", 6).any()


def test_external_force_is_asked_for_as_the_moment(library):
    given = (*GIVEN, "rpm", "moment_ext", "force_ext")
    words = words_of("e2e with a history")
    assert not Pilot(library, words, 10_000_000, given).wrong
    for name in given[-2:]:
        refused = Pilot(library, words, 10_000_000, tuple(n for n in given if n != name))
        assert b"external disturbances" in refused.wrong


def test_loading_leaves_nothing_of_the_self_tests(library):
    pilot = Pilot(library, words_of("published racing"), 10_000_000)
    assert set(pilot.numbers().values()) == {0}


def test_a_race_starts_at_the_first_position_that_is_one(library):
    own, policy, _, _ = fixed("published racing")
    pilot = Pilot(library, pack(policy), 10_000_000)
    gate = np.asarray(own.params.track.position)[:, 0]
    yaw = float(np.asarray(own.params.track.yaw)[0])
    ahead = gate + np.array([np.cos(yaw), np.sin(yaw), 0.0]) * 0.1
    behind = gate - np.array([np.cos(yaw), np.sin(yaw), 0.0]) * 0.1
    assert pilot.start_at(behind, [ahead]) == [1]
    for origin in (behind, ahead):  # of zeros taken for a position, one would be behind the gate
        assert pilot.start_at([np.nan] * 3, [ahead]) == [0], origin
    assert pilot.start_at([np.nan] * 3, [behind, ahead]) == [0, 1]
