"""The C of an export, compiled and loaded on this machine."""

import ctypes
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadjax.core.files import write_bytes
from quadjax.export.compiler import Compiler, host
from quadjax.export.conversion import Converted
from quadjax.export.header import glue_header
from quadjax.export.policy_in_c import COMMANDS
from quadjax.export.states import STATE
from quadjax.export.targets import RUNTIME

HOST = RUNTIME / "host"
EXACT = "-ffp-contract=off"  # so that floats are the same on every machine
FLYING, HELD, LOST = 1, 2, 3  # qj_pilot_status
VEHICLE = np.dtype([  # qj_vehicle
    ("time_us", "<u4"), ("position_us", "<u4"), ("position", "<f4", 3), ("velocity", "<f4", 3),
    ("quaternion", "<f4", 4), ("rates", "<f4", 3), ("rotor_speed", "<f4", 4), ("thrust", "<f4"),
    ("specific_force", "<f4", 3), ("body_velocity", "<f4", 3), ("autopilot_command", "<f4", 4),
])  # fmt: skip
COUNTS = ("steps", "outside steps", "late calls", "nan calls", "target", "passed", "missed")


class Library:
    """The runtime with a policy, on this machine; each method takes many rows at once."""

    def __init__(self, converted: Converted, work: Path, options: Sequence[str] = ()) -> None:
        """Compile the C of a policy in a folder.

        Raises:
            Skipped: no compiler.
            Failed: C that does not compile.
        """
        files = write_c(converted, work)
        self._library = load_library(host(), files, work / "policy.so", [f"-I{work}", *options])
        self._library.library_start.restype = ctypes.c_char_p
        self._inputs = converted.in_c.network.inputs

    def quantize(self, x: np.ndarray) -> np.ndarray:
        """Inputs (n, inputs) int32 of observations (n, inputs)."""
        return self._rows("quantize", self._inputs, np.int32, x.astype(np.float32))

    def forward(self, q: np.ndarray) -> np.ndarray:
        """Rows (n, 5) int32, commands and trace, of inputs (n, inputs)."""
        return self._rows("forward", COMMANDS + 1, np.int32, q.astype(np.int32))

    def act(self, q: np.ndarray, counter: int = 0) -> np.ndarray:
        """Commands (n, 4) float32 in their unit; with the noise of a counter, if it is not 0."""
        out = np.zeros((len(q), COMMANDS), np.float32)
        inputs = np.ascontiguousarray(q, np.int32)
        self._library.library_act(*pointers(inputs, out), len(q), ctypes.c_uint32(counter))
        return out

    def observe(self, states: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Observations (n, inputs) float32 of states (n,) of ``STATE`` and target gates (n,)."""
        out = np.zeros((len(states), self._inputs), np.float32)
        rows = np.ascontiguousarray(states, STATE), targets.astype(np.uint32), out
        self._library.library_observe(*pointers(*rows), len(states))
        return out

    def race(self, positions: np.ndarray, target: int) -> np.ndarray:
        """Rows (n, 2) uint32, the event and the target after it, along positions (n, 3), m."""
        out = np.zeros((len(positions), 2), np.uint32)
        out[0, 1] = target
        path = np.ascontiguousarray(positions, np.float32)
        self._library.library_race(*pointers(path, out), len(path))
        return out

    def disturbances(self, measured: np.ndarray) -> np.ndarray:
        """Moments, N m, and forces, m/s^2, (n, 6) along ``qj_measured`` (n, 13)."""
        return self._rows("disturbances", 6, np.float32, measured.astype(np.float32))

    def highest_rpm(self, samples: np.ndarray) -> np.ndarray:
        """Estimates (n,) along samples (n, 8): rotor speeds and the commands before them, rpm."""
        return self._rows("battery", 1, np.float32, samples.astype(np.float32))[:, 0]

    def _rows(self, name: str, columns: int, kind: type, x: np.ndarray) -> np.ndarray:
        out: np.ndarray = np.zeros((len(x), columns), kind)
        function = getattr(self._library, f"library_{name}")
        function(*pointers(np.ascontiguousarray(x), out), len(x))
        return out

    def pilot(self, frequency: float) -> "Pilot":
        """A pilot with the policy, whose calls come at a rate, Hz."""
        return Pilot(self._library, frequency)


class Pilot:
    """``qj_pilot`` on this machine.

    Attributes:
        wrong: why the policy cannot fly; None if it can.
    """

    def __init__(self, library: ctypes.CDLL, frequency: float) -> None:
        """Start it; see ``Library.pilot``."""
        self._library = library
        self._memory = np.zeros(library.library_pilot_size() // 8 + 1, np.int64)
        rate = ctypes.c_float(frequency)
        wrong = library.library_start(*pointers(self._memory), rate)
        self.wrong = wrong and wrong.decode()

    def reset(self) -> None:
        """The next step starts a race."""
        self._library.qj_pilot_reset(*pointers(self._memory))

    def standby(self, vehicle: np.ndarray | None) -> None:
        """A call in which the policy does not fly; ``vehicle`` as of ``call``."""
        place = None if vehicle is None else pointers(vehicle)[0]
        self._library.qj_pilot_standby(*pointers(self._memory), place)

    def call(self, now_us: int, vehicle: np.ndarray | None) -> tuple[int, np.ndarray]:
        """A call at a time: the status, and the commands (4,) float32.

        ``vehicle``: a ``VEHICLE`` (); None if there is no valid state.
        """
        command = np.zeros(COMMANDS, np.float32)
        memory, out = pointers(self._memory, command)
        place = None if vehicle is None else pointers(vehicle)[0]
        now = ctypes.c_uint32(now_us % 2**32)
        return self._library.qj_pilot_call(memory, now, place, out), command

    def estimate(self) -> np.ndarray:
        """External moment, N m, and force, m/s^2, and the highest speed, rpm: (7,) float32."""
        out = np.zeros(7, np.float32)
        self._library.library_estimate(*pointers(self._memory, out))
        return out

    def counts(self) -> dict[str, int]:
        """The counters and the race, by ``COUNTS``."""
        return dict(zip(COUNTS, self._counts().tolist()[:-1], strict=True))

    def outside(self) -> list[int]:
        """Inputs that were outside their range since the last reset; 31 stands for all others."""
        mask = int(self._counts()[-1])
        return [bit for bit in range(32) if mask >> bit & 1]

    def _counts(self) -> np.ndarray:
        counts = np.zeros(len(COUNTS) + 1, np.uint32)
        self._library.library_counts(*pointers(self._memory, counts))
        return counts


def write_c(converted: Converted, work: Path) -> list[Path]:
    """Write the C of a policy to a folder, without glue; returns what is compiled."""
    folder = converted.target.folder
    for name, data in converted.files.items():
        if name.startswith((f"{folder}/qj_", f"{folder}/qj.", f"{folder}/{converted.in_c.name}.")):
            write_bytes(work / Path(name).name, data)
    header = glue_header(converted.in_c, converted.race, converted.frequency)
    write_bytes(work / "quadjax_policy.h", header.encode())
    return [*sorted(work.glob("qj_*.c")), HOST / "library.c"]


def load_library(
    compiler: Compiler, sources: Sequence[Path], output: Path, extra: Sequence[str] = ()
) -> ctypes.CDLL:
    """Build C for this machine, and load it."""
    options = ["-shared", "-fPIC", EXACT, *extra]
    options += [] if sys.platform == "win32" else ["-lm"]
    return ctypes.CDLL(str(compiler.build(sources, output, options)))


def pointers(*arrays: np.ndarray) -> list[ctypes.c_void_p]:
    """The addresses of arrays, as arguments of C."""
    return [array.ctypes.data_as(ctypes.c_void_p) for array in arrays]
