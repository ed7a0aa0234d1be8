"""Races: what acts, what is held, rejected and counted, and how they end; faults of the link."""

import threading

import numpy as np

from quadjax.export.verify.build import VEHICLE
from quadjax.sil.faults import Channel, Faults
from quadjax.sil.fly import INTERRUPTED, fly
from tests.sil.support import STEPS, Autopilot, Counting


def race(faults=None, autopilot=None, stop=None):
    return fly(
        Counting(), autopilot or Autopilot(), faults or Faults(), 0, stop or threading.Event()
    )


def acting(flown):
    """The steps (n,) whose commands act."""
    return np.round(flown.flight["command"][:, 0] * 100.0)


def state():
    vehicle = np.zeros((), VEHICLE)
    vehicle["position"], vehicle["euler"] = [1.0, 2.0, 3.0], [0.0, np.pi, -np.pi]
    return vehicle


def test_without_faults_every_command_acts_in_its_own_step():
    autopilot = Autopilot()
    flown = race(autopilot=autopilot)
    assert flown.laps.finished == 1
    assert flown.counts == {"steps": STEPS, "autopilot: clipped steps": STEPS}
    expected = np.float32(np.arange(STEPS) / 100.0)
    np.testing.assert_array_equal(flown.flight["command"][:, 0], expected)
    np.testing.assert_array_equal(flown.flight["position"][:, 0], np.arange(STEPS))
    np.testing.assert_array_equal(flown.flight.target, np.arange(STEPS) % 4)
    assert autopilot.seen == [(step, step) for step in range(STEPS)]


def test_the_last_command_is_held_while_states_and_commands_are_lost_or_late():
    faults = Faults(drop=0.2, late=0.4, delay=0.03)
    one, two = Autopilot(), Autopilot()
    flown, again = race(faults, one), race(faults, two)
    np.testing.assert_array_equal(flown.flight["command"], again.flight["command"])
    assert flown.counts == again.counts and one.seen == two.seen
    assert all(by_time == by_position for by_time, by_position in one.seen)
    assert (np.diff([step for step, _ in one.seen]) > 0).all()  # none is out of date
    steps = acting(flown)
    assert (np.diff(steps) >= 0).all() and (steps <= np.arange(STEPS)).all()
    assert flown.counts["held steps"] >= np.sum(np.diff(steps) == 0)
    for name in ("dropped", "late", "rejected: out of date"):
        assert flown.counts[f"states {name}"] > 0, name
        assert flown.counts[f"commands {name}"] > 0, name


def test_before_the_first_command_the_drone_hovers():
    thrust = race(Faults(late=1.0, delay=0.05)).flight["command"][:, 3]
    np.testing.assert_array_equal(thrust[:5], np.float32(9.81))
    assert thrust[20] == 9.0


def test_a_command_out_of_range_is_clipped():
    flown = race(autopilot=Autopilot(lambda number: (0, 0, 0, 99.0 if number % 2 else 9.0)))
    assert flown.counts["clipped commands"] == STEPS // 2
    np.testing.assert_array_equal(flown.flight["command"][:, 3], [9.0, 15.0] * (STEPS // 2))


def test_ctrl_c_ends_the_race_with_its_record():
    stop = threading.Event()

    def reply(number):
        if number == 5:
            stop.set()
        return (0.0, 0.0, 0.0, 9.0)

    flown = race(autopilot=Autopilot(reply), stop=stop)
    assert flown.laps.crashes == (INTERRUPTED,) and len(flown.flight.time) == 6


def test_faults_are_drawn_from_the_seed_and_counted():
    def sent(seed):
        channel = Channel(Faults(drop=0.3, late=0.3, delay=0.02), seed, 0)
        arrived = []
        for step in range(500):
            channel.push(state(), step, 0.01 * step)
            arrived += [(step, s.number) for s in channel.due(0.01 * step)]
        return arrived, channel.counts

    (first, counts), (again, _), (other, _) = sent(1), sent(1), sent(2)
    assert first == again != other
    assert 0 <= 500 - counts["dropped"] - len(first) <= 2
    assert {step - number for step, number in first} == {0, 2}
    assert 100 < counts["dropped"] < 200 and counts["late"] > 60


def test_wrong_units_and_nan_change_the_states_alone():
    faults = Faults(nan={"position": 1.0}, units=("attitude=deg",))
    channel = Channel(faults, 0, 0)
    original = state()
    channel.push(original, 0, 0.0)
    found = channel.due(0.0)[0].data
    np.testing.assert_allclose(found["euler"], [0.0, 180.0, -180.0], rtol=1e-6)
    assert np.isnan(found["position"]).sum() == 1
    assert np.isfinite(original["position"]).all() and faults and not Faults()
    commands = Channel(faults.of_commands, 0, 1)
    commands.push(np.ones(4, np.float32), 0, 0.0)
    np.testing.assert_array_equal(commands.due(0.0)[0].data, np.ones(4))
