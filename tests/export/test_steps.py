"""The pilot alone: its clock of steps, what it reads, lost states and what loading leaves."""

import ctypes

import numpy as np
import pytest

from quadjax.export.targets import ANGLES, RATES, RPM, calls_per_step
from quadjax.export.targets import MOTOR as MOTORS
from quadjax.export.verify.build import VEHICLE, pointers
from quadjax.export.words import STATE_FIELDS, pack
from tests.export.support import fixed, made
from tests.export.words import at_of, edited, runtime_of

PILOT = np.dtype(  # the beginning of qj_pilot
    [("clock", "<u4", 10), ("command", "<f4", 4), ("disturbance", "<f4", 6)]
    + [("highest_rpm", "<f4"), ("last", "<u4", 3), ("steps", "<u4"), ("nan_steps", "<u4")]
    + [("clipped_steps", "<u4"), ("outside_steps", "<u4")]
    + [("estimator_calls", "<u4"), ("late_calls", "<u4")]
)
FLYING, HELD, LOST = 1, 2, 3
MEASURED = (*ANGLES, "rotor_speed")


class Pilot:
    """The pilot with the words of a policy."""

    def __init__(self, library, words, call_ns=10_000_000, gives=MEASURED):
        self._library, self._words = library, np.frombuffer(words, np.int32).copy()
        self._memory = np.zeros(2**17, np.int64)
        self.now = self._memory.view(np.uint8)[: PILOT.itemsize].view(PILOT)[0]
        fields = (*STATE_FIELDS, *[""] * (15 - len(STATE_FIELDS)), "sensors")
        bits = sum(1 << (1 + fields.index(name)) for name in gives)
        kinds = sum(1 << kind for kind in (RPM, MOTORS, RATES))
        interface = np.array([bits, kinds, call_ns], np.uint32)
        library.qj_pilot_load.restype = ctypes.c_char_p
        memory, data, taken = pointers(self._memory, self._words, interface)
        self.wrong = library.qj_pilot_load(memory, data, len(words), taken)
        assert not any(self.now[name] for name in PILOT.names[-6:])  # of the self-tests
        self.state = np.zeros(1, VEHICLE)
        self.state["quaternion"] = [1, 0, 0, 0]

    def call(self, now_us, time_us=None):
        """Status and commands of a call; ``time_us`` of the state."""
        out = np.zeros(4, np.float32)
        self.state["time_us"] = (now_us if time_us is None else time_us) % 2**32
        memory, state, command = pointers(self._memory, self.state, out)
        now = ctypes.c_uint32(now_us % 2**32)
        return self._library.qj_pilot_step(memory, now, state, command), out


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return runtime_of(tmp_path_factory.mktemp("pilot") / "c")


def words_of(name="racing, axes and more", period_us=None):
    words = pack(fixed(name))
    place = at_of(words, "header", "period_ns")
    return words if period_us is None else edited(words, {place: 1000 * period_us})


@pytest.mark.parametrize(
    ("rate", "period_ms", "expected"),
    [(2000, 10, 20), (1000, 20, 20), (1000, 10, 10), (512, 10, 5), (512, 20, 10), (100, 10, 1)],
)
def test_a_step_is_due_at_the_nearest_call(library, rate, period_ms, expected):
    pilot = Pilot(library, words_of(period_us=1000 * period_ms), round(1e9 / rate))
    assert not pilot.wrong and calls_per_step(rate, period_ms / 1e3) == expected
    start, steps = 2**32 - 5000, []  # the clock wraps around
    for call in range(3 * expected + 1):
        pilot.call(start + round(call * 1e6 / rate))
        steps.append(int(pilot.now["steps"]))
    assert np.flatnonzero(np.diff([0, *steps])).tolist() == [expected * i for i in range(4)]


@pytest.mark.parametrize("rate", [100, 500, 512, 1000, 2000])
def test_the_pilot_takes_the_steps_that_the_export_takes(library, rate):
    for period_us in (3000, 4000, 9800, 10_000, 10_500, 15_000, 19_500, 20_000, 33_333):
        pilot = Pilot(library, words_of(period_us=period_us), round(1e9 / rate))
        assert bool(pilot.wrong) != bool(calls_per_step(rate, period_us / 1e6)), period_us


def test_steps_follow_the_calls_not_the_states(library):
    pilot = Pilot(library, words_of())
    for call in range(50):  # states of 250 Hz: 8 or 12 ms apart
        now = 1_000_000 + 10_000 * call
        assert pilot.call(now, now - now % 4000)[0] == FLYING
    assert pilot.now["steps"] == 50


def test_a_state_newer_than_the_call_is_used_but_none_of_the_far_future(library):
    pilot = Pilot(library, words_of())
    for now in (1_000_000, 1_010_000):
        assert pilot.call(now, now + 50)[0] == FLYING
    assert pilot.now["late_calls"] == 0
    for ahead in (100_001, 2**30, 2**31 - 1):
        assert pilot.call(1_020_000, 1_020_000 + ahead)[0] == HELD
    assert pilot.call(1_030_000)[0] == FLYING  # the state of the future is not the newest one


def test_stale_and_repeated_states_hold_then_stop(library):
    pilot = Pilot(library, words_of())
    assert pilot.call(1_000_000, 899_999)[0] == LOST  # no race yet, and the state is 100 ms old
    pilot.call(1_000_000)
    status, flown = pilot.call(1_010_000)
    assert status == FLYING and np.all(flown != 0)
    for call in range(1, 12):
        status, held = pilot.call(1_010_000 + 10_000 * call, 1_010_000)  # the same state
        assert status == HELD
        np.testing.assert_array_equal(held, flown)
    status, stopped = pilot.call(1_130_000, 1_010_000)
    assert status == LOST and not stopped.any() and not pilot.now["command"].any()
    assert pilot.now["late_calls"] == 13
    status, again = pilot.call(1_131_000)  # a step at the first new state
    assert status == FLYING and np.all(again != 0)


def test_what_is_not_given_is_not_read(library):
    words = words_of("published racing")
    expected = Pilot(library, words).call(1_000_000)[1]
    for name in ("moment_ext", "force_ext", "rpm", "gyro", "specific_force", "body_velocity"):
        pilot = Pilot(library, words)
        pilot.state[name] = np.nan
        np.testing.assert_array_equal(pilot.call(1_000_000)[1], expected)
        assert pilot.now["nan_steps"] == 0 and not pilot.now["disturbance"].any()


def test_estimators_count_calls_with_wrong_measurements(library):
    period = fixed("everything").estimator.period_ns
    pilot = Pilot(library, words_of("everything"), period, (*MEASURED, "rpm", "sensors"))
    assert not pilot.wrong
    pilot.state["specific_force"] = [0, 0, -9.81]
    now, wrong = 0, 0
    for name, value in (("gyro", 0.1), ("gyro", np.nan), ("gyro", 0.1), ("rpm", 1e9), ("rpm", 5e3)):
        pilot.state[name] = value
        now += period // 1000
        assert pilot.call(now)[0] == FLYING
        wrong += not abs(value) < 1e6
        assert pilot.now["estimator_calls"] == wrong
        assert np.isfinite(pilot.now["disturbance"]).all()
    assert pilot.now["disturbance"].any()


def test_external_force_is_asked_for_as_the_moment(library):
    given = (*MEASURED, "rpm", "moment_ext", "force_ext")
    words = words_of("published e2e")
    assert not Pilot(library, words, gives=given).wrong
    for name in given[-2:]:
        refused = Pilot(library, words, gives=tuple(n for n in given if n != name))
        assert b"external disturbances" in refused.wrong


def test_a_race_starts_at_the_first_position_that_is_one(library):
    track = made("published racing")[1].params.track
    words = np.frombuffer(words_of("published racing"), np.int32).copy()
    policy, race = (np.zeros(size, np.uint8) for size in (4096, 64))
    assert library.qj_load(*pointers(policy, words), words.nbytes) == 0

    def events(first, *positions):
        start, *path = (np.asarray(x, np.float32) for x in (first, *positions))
        library.qj_race_start(*pointers(policy, race, start), 0)
        return [library.qj_race_update(*pointers(policy, race, place)) for place in path]

    gate, yaw = np.asarray(track.position)[:, 0], float(track.yaw[0])
    ahead, behind = (gate + s * np.array([np.cos(yaw), np.sin(yaw), 0.0]) for s in (0.1, -0.1))
    nowhere = [np.nan] * 3
    assert events(behind, ahead) == [1]
    assert events(nowhere, ahead) == [0]  # of zeros taken for a position, it may be a passage
    assert events(nowhere, behind, ahead) == [0, 1]
