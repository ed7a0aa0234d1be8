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


def race(reply, faults=None, timing=None, stop=None):
    stop = stop or threading.Event()
    with connected(reply, stop=stop) as peer:
        return fly(Counting(), peer, faults or Faults(), timing or Timing(), 0, 0, stop)


def good(state):
    return [pack(answer(state))]


def test_in_lock_step_every_command_acts_in_its_own_step():
    flown = race(good)
    assert flown.laps.finished == 1 and flown.counts == {"steps": STEPS}
    expected = np.float32(np.arange(STEPS) / 100.0)
    np.testing.assert_array_equal(flown.flight["command"][:, 0], expected)
    np.testing.assert_array_equal(flown.flight["position"][:, 0], np.arange(STEPS))
    np.testing.assert_array_equal(flown.flight.target, np.arange(STEPS) % 4)


def test_the_last_command_is_held_while_messages_are_dropped_or_late():
    faults = Faults(drop=0.4, late=0.4, delay=0.03, damage=0.1)
    flown, again = race(good, faults), race(good, faults)
    np.testing.assert_array_equal(flown.flight["command"], again.flight["command"])
    assert flown.counts == again.counts
    acting = np.round(flown.flight["command"][:, 0] * 100.0)
    assert (np.diff(acting) >= 0).all() and (acting <= np.arange(STEPS)).all()
    assert flown.counts["held steps"] >= np.sum(np.diff(acting) == 0)
    assert flown.counts["states dropped"] > 0 and flown.counts["commands dropped"] > 0


def test_before_the_first_command_the_drone_hovers():
    flown = race(good, Faults(late=1.0, delay=0.05))
    np.testing.assert_array_equal(flown.flight["command"][:5, 3], np.float32(9.81))
    assert flown.flight["command"][20, 3] == 9.0


def test_a_command_that_is_not_finite_is_rejected_and_one_out_of_range_clipped():
    def reply(state):
        command = answer(state)
        if state["sequence"] % 2:
            command["command"][0] = np.nan
        else:
            command["command"][3] = 99.0
        return [pack(command)]

    flown = race(reply)
    assert flown.counts["commands rejected: not finite, or of another kind"] == STEPS // 2
    assert flown.counts["held steps"] == flown.counts["clipped commands"] == STEPS // 2
    assert (flown.flight["command"][:, 3] == 15.0).all()


def test_messages_that_are_none_or_of_another_race_are_rejected():
    def reply(state):
        other = answer(state)
        other["run"] = 9
        return [b"nonsense", pack(new(Kind.HELLO)), pack(other), pack(answer(state))]

    flown = race(reply)
    assert flown.laps.finished == 1 and "held steps" not in flown.counts
    for reason in ("no message of this format", "no command", "another step or race"):
        assert flown.counts[f"commands rejected: {reason}"] == STEPS


def test_an_autopilot_that_leaves_or_is_silent_ends_the_race_with_its_record():
    def reply(state):
        return [pack(new(Kind.END))] if state["sequence"] == 10 else good(state)

    flown = race(reply)
    assert flown.gone is not None and "has ended" in str(flown.gone)
    assert flown.laps.crashes == (LOST,) and len(flown.flight.time) == 10
    flown = race(lambda state: [], timing=Timing(speed=100.0, timeout=0.001))
    assert flown.gone is not None and "has not answered" in str(flown.gone)


def test_in_real_time_a_missing_command_is_counted_and_the_last_one_held():
    silent = {3, 4, 11}

    def reply(state):
        return [] if int(state["sequence"]) in silent else good(state)

    flown = race(reply, timing=Timing(speed=2.0, timeout=30.0))
    assert flown.laps.finished == 1 and flown.gone is None
    assert flown.counts["late steps"] >= len(silent)
    acting = np.round(flown.flight["command"][:, 0] * 100.0)
    assert not silent & set(acting.astype(int))


def test_ctrl_c_ends_the_race_with_its_record():
    stop = threading.Event()

    def reply(state):
        if state["sequence"] == 5:
            stop.set()
        return good(state)

    flown = race(reply, stop=stop)
    assert flown.laps.crashes == (INTERRUPTED,) and 5 <= len(flown.flight.time) <= 6


BAD = {
    "version 7, allowed: 1": pack(hello())[:4] + b"\7" + pack(hello())[5:],
    "no message of this format": b"hello",
    "no hello": pack(new(Kind.COMMAND)),
    "this drone takes 2": pack(hello(CommandKind.MOTORS_0_TO_1)),
    "3 self-test mismatches": pack(hello(mismatches=3)),
}


def test_a_peer_that_does_not_fit_is_one_line():
    for reason, first in BAD.items():
        with pytest.raises(InputError, match=reason), connected(good, first=first):
            pass
    with listening(ADDRESS, 0) as own:
        port = own.getsockname()[1]
        with pytest.raises(InputError, match=f"--listen 127.0.0.1:{port}: cannot listen"):
            with listening(ADDRESS, port):
                pass
