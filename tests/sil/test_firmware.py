"""The process of Betaflight's firmware ends in every case; here a script is in its place."""

import sys
from pathlib import Path

import numpy as np
import psutil
import pytest

from quadjax.core.errors import InputError
from quadjax.sil import betaflight_firmware
from quadjax.sil.betaflight_firmware import ATTEMPTS, Firmware, check_set

SCRIPT = """\
#!{python}
import os, socket, struct, time

with open({pids!r}, "a") as file:
    print(os.getpid(), file=file)
state, line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), socket.socket()
for link in (state, line):
    link.bind(("127.0.0.1", 0))
line.listen()
ports = [link.getsockname()[1] for link in (state, state, line)]
motors = ("127.0.0.1", int(os.environ["QUADJAX_MOTORS"]))
if {starts}:
    state.sendto(struct.pack("3H", *ports), motors)
    command_line = line.accept()[0]
    while (asked := command_line.recv(64)) != b"save\\n":
        command_line.sendall(asked.replace(b" = ", b" to ").replace(b"set p_roll", b"p_roll set"))
        command_line.sendall(b"\\n# ")
    if {saves}:
        raise SystemExit
time.sleep(60)
"""


@pytest.fixture
def firmware(tmp_path, monkeypatch):
    """Makes a firmware that is a script; the file of its process ids."""
    (tmp_path / "empty.c").write_text("static int none;\nint *nothing(void) { return &none; }\n")
    monkeypatch.setattr(betaflight_firmware, "LOCKSTEP", tmp_path / "empty.c")
    monkeypatch.setattr(betaflight_firmware, "ANSWER_S", 2.0)

    def make(**does: bool) -> tuple[Firmware, Path]:
        script, pids = tmp_path / "script", tmp_path / "pids"
        script.write_text(SCRIPT.format(python=sys.executable, pids=str(pids), **does))
        script.chmod(0o755)
        return Firmware(script, ["set p_roll = 60"]), pids

    return make


def ended(pids: Path) -> list[bool]:
    return [not psutil.pid_exists(int(pid)) for pid in pids.read_text().split()]


def test_a_firmware_that_does_not_start_is_ended_each_time(firmware, monkeypatch):
    monkeypatch.setattr(betaflight_firmware, "START_S", 1.5)
    made, pids = firmware(starts=False, saves=False)
    with pytest.raises(InputError, match="script does not start"), made:
        pass
    assert ended(pids) == [True] * ATTEMPTS


def test_a_firmware_that_does_not_end_after_saving_is_refused(firmware):
    made, pids = firmware(starts=True, saves=False)
    with pytest.raises(InputError, match="script does not store its settings"), made:
        pass
    assert ended(pids) == [True]


def test_a_firmware_that_does_not_answer_is_refused_and_ended(firmware):
    made, pids = firmware(starts=True, saves=True)
    with pytest.raises(InputError, match="script does not answer within 2 s"), made:
        made.exchange(np.zeros(17), [1500])
    assert ended(pids) == [True, True]


@pytest.mark.parametrize("value", ["60.7", "1e2", "abc"])
def test_a_value_that_the_firmware_reads_as_another_is_refused(value):
    check_set("set p_roll = 60", "set p_roll = 60\r\np_roll set to 60\r\n# ")
    check_set("set rc_smoothing = off", "rc_smoothing set to OFF\r\n# ")
    with pytest.raises(InputError, match="p_roll=60 is read as nothing"):
        check_set("set p_roll = 60", "# ")
    check_set("feature AIRMODE", "AlreadyEnabled AIRMODE\r\n\r\n# ")
    with pytest.raises(InputError, match=f"p_roll={value} is read as 60"):
        check_set(f"set p_roll = {value}", f"set p_roll = {value}\r\np_roll set to 60\r\n# ")
