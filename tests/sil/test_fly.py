"""Races over the socket: what acts, what is held, rejected and counted, and how they end."""

import threading

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.sil.faults import Faults
from quadjax.sil.fly import INTERRUPTED, LOST, Timing, fly
from quadjax.sil.message import CommandKind, Kind, new, pack
from quadjax.sil.peer import ADDRESS, listening
from tests.sil.support import STEPS, Counting, answer, connected, hello


def good(state):
    return [answer(state)]


def race(reply=good, faults=None, timing=None, stop=None, first=None):
    """A race whose autopilot answers states by ``reply``, and begins with ``first``."""
    stop = stop or threading.Event()
    with connected(reply, first or hello(), stop) as peer:
        return fly(Counting(), peer, faults or Faults(), timing or Timing(), 0, 0, stop)


def acting(flown):
    """The steps (n,) whose commands act."""
    return np.round(flown.flight["command"][:, 0] * 100.0)


def test_in_lock_step_every_command_acts_in_its_own_step():
    flown = race()
    assert flown.laps.finished == 1 and flown.counts == {"steps": STEPS}
    expected = np.float32(np.arange(STEPS) / 100.0)
    np.testing.assert_array_equal(flown.flight["command"][:, 0], expected)
    np.testing.assert_array_equal(flown.flight["position"][:, 0], np.arange(STEPS))
    np.testing.assert_array_equal(flown.flight.target, np.arange(STEPS) % 4)


def test_the_last_command_is_held_while_messages_are_dropped_or_late():
    faults = Faults(drop=0.4, late=0.4, delay=0.03, damage=0.1)
    flown, again = race(faults=faults), race(faults=faults)
    np.testing.assert_array_equal(flown.flight["command"], again.flight["command"])
    assert flown.counts == again.counts
    steps = acting(flown)
    assert (np.diff(steps) >= 0).all() and (steps <= np.arange(STEPS)).all()
    assert flown.counts["held steps"] >= np.sum(np.diff(steps) == 0)
    assert flown.counts["states dropped"] > 0 and flown.counts["commands dropped"] > 0


def test_before_the_first_command_the_drone_hovers():
    thrust = race(faults=Faults(late=1.0, delay=0.05)).flight["command"][:, 3]
    np.testing.assert_array_equal(thrust[:5], np.float32(9.81))
    assert thrust[20] == 9.0


def test_a_command_that_is_not_finite_is_rejected_and_one_out_of_range_clipped():
    def reply(state):
        wrong = [np.nan, 0, 0, 9] if state["sequence"] % 2 else [0, 0, 0, 99.0]
        return [answer(state, command=wrong)]

    flown = race(reply)
    assert flown.counts["commands rejected: not finite, or of another kind"] == STEPS // 2
    assert flown.counts["held steps"] == flown.counts["clipped commands"] == STEPS // 2
    assert (flown.flight["command"][:, 3] == 15.0).all()


def test_messages_that_are_none_or_of_another_race_are_rejected():
    flown = race(lambda state: [b"nonsense", hello(), answer(state, run=9), answer(state)])
    assert flown.laps.finished == 1 and "held steps" not in flown.counts
    for reason in ("no message of this format", "no command", "another step or race"):
        assert flown.counts[f"commands rejected: {reason}"] == STEPS


def test_an_autopilot_that_leaves_or_is_silent_ends_the_race_with_its_record():
    flown = race(lambda state: [pack(new(Kind.END))] if state["sequence"] == 10 else good(state))
    assert flown.gone is not None and "has ended" in str(flown.gone)
    assert flown.laps.crashes == (LOST,) and len(flown.flight.time) == 10
    flown = race(lambda state: [], timing=Timing(speed=100.0, timeout=0.001))
    assert flown.gone is not None and "has not answered" in str(flown.gone)


def test_in_real_time_a_missing_command_is_counted_and_the_last_one_held():
    silent = {3, 4, 11}
    timing = Timing(speed=2.0, timeout=30.0)
    flown = race(lambda s: [] if int(s["sequence"]) in silent else good(s), timing=timing)
    assert flown.laps.finished == 1 and flown.gone is None
    assert flown.counts["late steps"] >= len(silent)
    assert not silent & set(acting(flown).astype(int))


def test_ctrl_c_ends_the_race_with_its_record():
    stop = threading.Event()

    def reply(state):
        if state["sequence"] == 5:
            stop.set()
        return good(state)

    flown = race(reply, stop=stop)
    assert flown.laps.crashes == (INTERRUPTED,) and 5 <= len(flown.flight.time) <= 6


def test_a_peer_that_does_not_fit_is_one_line():
    for reason, first in {
        "version 7, allowed: 1": hello()[:4] + b"\7" + hello()[5:],
        "no message of this format": b"hello",
        "no hello": pack(new(Kind.COMMAND)),
        "this drone takes 2": hello(CommandKind.MOTORS_0_TO_1),
        "3 self-test mismatches": hello(mismatches=3),
    }.items():
        with pytest.raises(InputError, match=reason):
            race(first=first)
    with listening(ADDRESS, 0) as link:
        port = link.getsockname()[1]
        with pytest.raises(InputError, match=f"--listen 127.0.0.1:{port}: cannot listen"):
            with listening(ADDRESS, port):
                pass
