"""The pilot: its clock of steps, lost and stale states, what is not finite, gaps, takeover."""

import dataclasses

import numpy as np
import pytest

from quadjax.export import motions
from quadjax.export.library import FLYING, HELD, LOST, VEHICLE
from quadjax.export.targets import calls_per_step
from tests.export.support import converted, library

STEP_US = 10_000
HELD_STEPS = "racing, axes and more"  # observes its last action: a step is a whole number of calls
ESTIMATING = "everything"


def level():
    """A drone at rest."""
    vehicle = np.zeros((), VEHICLE)
    vehicle["quaternion"], vehicle["specific_force"] = [1, 0, 0, 0], [0, 0, -9.81]
    vehicle["rotor_speed"] = 700.0
    return vehicle


class Flight:
    """A pilot at a rate of calls, which gets a state with every call unless a test says no."""

    def __init__(self, c, rate=100.0):
        self.pilot, self.vehicle = c.pilot(rate), level()
        assert self.pilot.wrong is None

    def call(self, now_us, time_us=None, position_us=None, **numbers):
        for name, value in numbers.items():
            self.vehicle[name] = value
        time_us = now_us if time_us is None else time_us
        self.vehicle["time_us"] = time_us % 2**32
        self.vehicle["position_us"] = (time_us if position_us is None else position_us) % 2**32
        return self.pilot.call(now_us, self.vehicle)

    def count(self, name):
        return self.pilot.counts()[name]


@pytest.fixture(scope="module")
def c(tmp_path_factory):
    """Libraries by race and time step, s."""
    made = {}

    def of(name=HELD_STEPS, step_s=None, rate=512.0):
        if (name, step_s, rate) not in made:
            folder = tmp_path_factory.mktemp("pilot")
            of = converted(name, folder, sample_rate=rate)
            if step_s is not None:
                seen = dataclasses.replace(of.in_c.observation, time_step=step_s)
                of = dataclasses.replace(of, in_c=dataclasses.replace(of.in_c, observation=seen))
            made[name, step_s, rate] = library(of, folder / "c")
        return made[name, step_s, rate]

    return of


@pytest.mark.parametrize(
    ("rate", "step_ms", "expected"),
    [(2000, 10, 20), (1000, 20, 20), (1000, 10, 10), (512, 10, 5), (512, 20, 10), (100, 10, 1)],
)
def test_a_step_is_due_at_the_nearest_call(c, rate, step_ms, expected):
    flight = Flight(c(step_s=step_ms / 1e3), rate)
    assert calls_per_step(rate, step_ms / 1e3) == expected
    start, steps = 2**32 - 5000, []  # the clock wraps around
    for call in range(3 * expected + 1):
        flight.call(start + round(call * 1e6 / rate))
        steps.append(flight.count("steps"))
    assert np.flatnonzero(np.diff([0, *steps])).tolist() == [expected * i for i in range(4)]


@pytest.mark.parametrize("rate", [100, 512, 1000])
def test_the_pilot_takes_the_steps_that_the_export_takes(c, rate):
    for step_us in (3000, 9800, 10_000, 10_500, 19_500, 33_333):
        wrong = c(step_s=step_us / 1e6).pilot(rate).wrong
        assert bool(wrong) != bool(calls_per_step(rate, step_us / 1e6)), step_us
    assert "whole number of calls" in c(step_s=3e-3).pilot(100).wrong


def test_a_policy_without_its_last_action_runs_at_every_call(c):
    flight = Flight(c("published racing"), 333.0)
    for call in range(7):
        flight.call(3003 * call)
    assert flight.count("steps") == 7


def test_the_rate_of_the_calls_is_that_of_the_estimators(c):
    assert "another rate" in c(ESTIMATING).pilot(500.0).wrong
    assert c(ESTIMATING).pilot(510.0).wrong is None
    for rate in (0.0, np.nan, 1e9):
        assert "rate of the calls" in c("published racing").pilot(rate).wrong


def test_stale_and_repeated_states_hold_then_stop(c):
    flight = Flight(c())
    assert flight.call(1_000_000, 899_999)[0] == LOST  # no race yet, and the state is 100 ms old
    flight.call(1_000_000)
    status, flown = flight.call(1_010_000)
    assert status == FLYING and np.all(flown != 0)
    for call in range(1, 12):
        status, held = flight.call(1_010_000 + STEP_US * call, 1_010_000)  # the same state
        assert status == HELD
        np.testing.assert_array_equal(held, flown)
    status, stopped = flight.call(1_130_000, 1_010_000)
    assert status == LOST and not stopped.any()
    assert flight.count("late calls") == 13
    status, again = flight.call(1_131_000)  # a step at the first new state
    assert status == FLYING and np.all(again != 0)


def test_a_position_that_is_old_is_no_state(c):
    flight = Flight(c())
    assert flight.call(1_000_000)[0] == FLYING
    assert flight.call(1_010_000, position_us=920_000)[0] == FLYING
    assert flight.call(1_020_000, position_us=919_000)[0] == HELD  # though the rates are new
    assert flight.call(1_030_000, position_us=1_140_000)[0] == HELD  # of the far future


def test_a_state_of_the_future_is_not_the_newest_one(c):
    flight = Flight(c())
    for now in (1_000_000, 1_010_000):
        assert flight.call(now, now + 50)[0] == FLYING
    for ahead in (100_001, 2**30, 2**31 - 1):
        assert flight.call(1_020_000, 1_020_000 + ahead)[0] == HELD
    assert flight.call(1_030_000)[0] == FLYING


def test_after_half_a_second_it_stays_lost_until_a_reset(c):
    for gap_us, status in ((490_000, FLYING), (520_000, LOST)):
        flight = Flight(c())
        flight.call(1_000_000)
        now = 1_010_000
        for now in range(1_010_000, 1_010_000 + gap_us, STEP_US):
            assert flight.pilot.call(now, None)[0] == (HELD if now < 1_115_000 else LOST)
        assert flight.call(now + STEP_US)[0] == status
        for later in (2**31, 2**32 - 1_000_000, 2**32 + 1_200_000):  # the clock wraps around
            assert flight.call(now + later)[0] == LOST  # also after a race that went on
        flight.pilot.reset()
        assert flight.call(now + 2**32 + 2_000_000)[0] == FLYING


def test_no_vehicle_is_no_state(c):
    pilot = c().pilot(100.0)
    assert pilot.call(0, None)[0] == LOST and not pilot.call(0, None)[1].any()
    pilot.standby(None)
    assert pilot.counts()["late calls"] == 2


@pytest.mark.parametrize("bad", [np.nan, np.inf, -3e38])
def test_a_state_with_a_number_that_is_not_finite_is_no_state(c, bad):
    for name in [name for name in VEHICLE.names if not name.endswith("_us")]:
        flight = Flight(c("published racing"))
        assert flight.call(0)[0] == FLYING
        good = np.array(flight.vehicle[name])
        statuses = [flight.call(now, **{name: bad})[0] for now in range(10_000, 300_000, STEP_US)]
        assert statuses[:9] == [HELD] * 9 and statuses[-10:] == [LOST] * 10, name
        assert flight.count("nan calls") == len(statuses)
        assert flight.call(310_000, **{name: good})[0] == FLYING


def test_commands_are_in_range_for_numbers_of_any_bits(c):
    rng = np.random.default_rng(0)
    for name, low, high in ((ESTIMATING, 3000, 11000), (HELD_STEPS, 0, 1)):
        flight, now, flown = Flight(c(name), 512.0 if name == ESTIMATING else 100.0), 0, 0
        for number in range(600):
            flight.vehicle = level()
            if number % 2:  # one field at a time: some of these states are used
                field = VEHICLE.names[2 + number // 2 % (len(VEHICLE.names) - 2)]
                size = flight.vehicle[field].shape
                bits = rng.integers(0, 2**32, size or 1, dtype=np.uint32)
                flight.vehicle[field] = bits.view(np.float32).reshape(size)
            now += 1953 if name == ESTIMATING else STEP_US
            status, command = flight.call(now)
            flown += number % 2 * (status == FLYING)
            in_range = np.all((command >= low) & (command <= high))
            assert not command.any() if status == LOST else in_range
        assert 20 < flown < 200


def tumble(c, drop, calls=1500):
    """Estimates (calls, 7) of a drone that tumbles, of which a share of the calls has no state."""
    rng, log = np.random.default_rng(0), motions.tumbling(np.random.default_rng(1), 512.0, 4.0)
    flight, estimates = Flight(c(ESTIMATING), 512.0), []
    for call, row in enumerate(log[:calls]):
        now = round(1e6 * call / 512.0)
        if call and rng.random() < drop:
            flight.pilot.call(now, None)
        else:
            parts = {"rates": row[:3], "specific_force": row[3:6], "body_velocity": row[10:]}
            flight.call(now, rotor_speed=row[6:10] * np.pi / 30.0, **parts)
        estimates.append(flight.pilot.estimate())
    return np.array(estimates)[200:]


def test_the_estimators_go_on_through_gaps(c):
    """Calls without a state are filled in: the estimates are those without gaps, but for noise."""
    whole = tumble(c, 0.0)
    for drop, share in ((0.1, 0.05), (0.3, 0.1)):
        apart = np.sqrt(np.mean((tumble(c, drop) - whole) ** 2, axis=0))
        assert np.all(apart[:6] < share * np.std(whole, axis=0)[:6]), drop


def test_after_a_long_gap_the_estimate_starts_where_it_was(c):
    """A jump of the rates over the gap is no moment of one call."""
    flight, estimates = Flight(c(ESTIMATING), 512.0), []
    for call in range(300):
        now = round(1e6 * call / 512.0)
        if 200 < call < 240:
            flight.pilot.call(now, None)
        else:
            flight.call(now, rates=[0.4 * (call > 200), 0, 0])
            estimates.append(flight.pilot.estimate()[:3])
    jump = np.abs(np.array(estimates[201:]) - estimates[200]).max()
    assert jump < 3e-3  # N m; in one call it would be above 0.008


def test_a_race_is_given_up_where_nobody_called(c):
    for apart, status in ((400_000, FLYING), (600_000, LOST), (20_000_000, LOST)):
        flight = Flight(c())
        assert flight.call(1_000_000)[0] == FLYING
        assert flight.call(1_000_000 + apart)[0] == status
        flight.pilot.reset()
        assert flight.call(1_100_000 + apart)[0] == FLYING


def test_the_autopilots_commands_count_while_it_flies(c):
    """The battery's estimate learns from them, and a race starts from it."""
    flight, other = Flight(c(ESTIMATING), 512.0), Flight(c(ESTIMATING), 512.0)
    for call in range(600):
        for one, command in ((flight, 11_000.0), (other, 4000.0)):
            one.vehicle["rotor_speed"] = 1000.0
            one.vehicle["autopilot_command"] = command
            one.vehicle["time_us"] = one.vehicle["position_us"] = round(1e6 * call / 512.0)
            one.pilot.standby(one.vehicle)
    now = round(1e6 * 600 / 512.0)
    assert not np.array_equal(flight.call(now)[1], other.call(now)[1])
    assert flight.count("steps") == 1


def test_a_race_begins_again_after_the_autopilot_flew(c):
    flight = Flight(c())
    first = [flight.call(STEP_US * call)[1] for call in range(5)]
    flight.vehicle["time_us"] = flight.vehicle["position_us"] = 5 * STEP_US
    flight.pilot.standby(flight.vehicle)
    again = [flight.call(STEP_US * call)[1] for call in range(6, 11)]
    np.testing.assert_array_equal(first, again)
