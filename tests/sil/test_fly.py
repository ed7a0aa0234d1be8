"""Races: what acts, what is held and counted, and how they end; faults of the states."""

import threading

import numpy as np

from quadjax.export.library import HELD, LOST, VEHICLE
from quadjax.sil.faults import FIELDS, WRONG_UNITS, Channel, Faults
from quadjax.sil.fly import INTERRUPTED, fly
from tests.sil.support import STEPS, Autopilot, Counting


def race(faults=None, autopilot=None, stop=None):
    return fly(
        Counting(), autopilot or Autopilot(), faults or Faults(), 0, stop or threading.Event()
    )


def acting(flown):
    """The steps (n,) of the states whose commands act."""
    return np.round(flown.flight["command"][:, 0] * 100.0)


def state(step=0):
    vehicle = np.zeros((), VEHICLE)
    vehicle["position"], vehicle["rates"] = [1.0 + step, 2.0, 3.0], [0.0, np.pi, -np.pi]
    return vehicle


def test_without_faults_every_command_acts_in_its_own_step():
    autopilot = Autopilot()
    flown = race(autopilot=autopilot)
    assert flown.laps.finished == 1
    assert flown.counts == {"steps": STEPS, "autopilot: outside steps": STEPS}
    expected = np.float32(np.arange(STEPS) / 100.0)
    np.testing.assert_array_equal(flown.flight["command"][:, 0], expected)
    np.testing.assert_array_equal(flown.flight["position"][:, 0], np.arange(STEPS))
    np.testing.assert_array_equal(flown.flight.target, np.arange(STEPS) % 4)
    assert autopilot.seen == [(10_000 * step, step) for step in range(STEPS)]


def test_the_newest_state_is_given_while_states_are_lost_or_late():
    faults = Faults(drop=0.2, late=0.4, delay=0.03)
    one, two = Autopilot(), Autopilot()
    flown, again = race(faults, one), race(faults, two)
    np.testing.assert_array_equal(flown.flight["command"], again.flight["command"])
    assert flown.counts == again.counts and one.seen == two.seen
    steps = acting(flown)[4:]
    assert (steps <= np.arange(4, STEPS)).all() and len(np.unique(steps)) > 10
    assert len(one.seen) == STEPS  # it is called in every step
    for name in ("dropped", "late"):
        assert flown.counts[f"states {name}"] > 0, name


def test_before_the_first_state_the_drone_hovers():
    thrust = race(Faults(late=1.0, delay=0.05)).flight["command"][:, 3]
    np.testing.assert_array_equal(thrust[:5], np.float32(9.81))
    assert thrust[20] == 9.0


def test_a_command_out_of_range_is_clipped_and_a_lost_pilot_counts():
    replies = {LOST: (0, 0, 0, 0), HELD: (0, 0, 0, 99.0)}
    autopilot = Autopilot(statuses=lambda number: LOST if number >= 30 else HELD if number else 1)
    autopilot.replies = replies
    flown = race(autopilot=autopilot)
    assert flown.counts["steps without a state"] == 10
    np.testing.assert_array_equal(flown.flight["command"][1:30, 3], 15.0)
    np.testing.assert_array_equal(flown.flight["command"][30:, 3], 0.0)


def test_ctrl_c_ends_the_race_with_its_record():
    stop = threading.Event()

    def reply(number):
        if number == 5:
            stop.set()
        return (0.0, 0.0, 0.0, 9.0)

    flown = race(autopilot=Autopilot(reply), stop=stop)
    assert flown.laps.crashes == (INTERRUPTED,) and len(flown.flight.time) == 6
    stop.set()
    assert len(race(stop=stop).flight.time) == 0


def test_faults_are_drawn_from_the_seed_and_counted():
    def arrived(seed):
        channel = Channel(Faults(drop=0.3, late=0.3, delay=0.02), seed)
        newest = [channel.newest(state(step), 0.01 * step) for step in range(500)]
        return [None if x is None else int(x["position"][0]) for x in newest], channel.counts

    (first, counts), (again, _), (other, _) = arrived(1), arrived(1), arrived(2)
    assert first == again != other
    ages = {step - number + 1 for step, number in enumerate(first) if number is not None}
    assert {0, 1, 2} <= ages and max(ages) < 10
    assert 100 < counts["dropped"] < 200 and counts["late"] > 60


def test_a_stuck_field_has_the_numbers_of_the_state_before():
    channel = Channel(Faults(stuck={"position": 1.0}), 0)
    found = [channel.newest(state(step), 0.01 * step) for step in range(3)]
    assert [x["position"][0] for x in found] == [1.0, 1.0, 1.0] and channel.counts["stuck"] == 2
    rarely = Channel(Faults(stuck={"position": 0.3}), 0)
    found = [rarely.newest(state(step), 0.01 * step) for step in range(200)]
    assert 30 < (np.diff([x["position"][0] for x in found]) == 0).sum() < 90


def test_wrong_units_and_nan_change_a_copy_of_the_state():
    units = ("rates=deg/s", "rotor_speed=rpm", "velocity=cm/s")
    channel, original = Channel(Faults(nan={"position": 1.0}, units=units), 0), state()
    original["rotor_speed"], original["velocity"] = 100.0 * np.pi, 2.0
    found = channel.newest(original, 0.0)
    np.testing.assert_allclose(found["rotor_speed"], 3000.0, rtol=1e-6)
    np.testing.assert_array_equal(found["velocity"], 200.0)
    np.testing.assert_allclose(found["rates"], [0.0, 180.0, -180.0], rtol=1e-6)
    assert np.isnan(found["position"]).sum() == 1 and np.isfinite(original["position"]).all()
    assert set(FIELDS.values()) <= set(VEHICLE.names)
    assert {name for names, _ in WRONG_UNITS.values() for name in names} <= set(VEHICLE.names)
    assert Faults(drop=0.1) and Faults(stuck={"rates": 0.1}) and not Faults(nan={"rates": 0.0})
