"""The glue of an autopilot in a stand-in for its firmware, on this machine."""

import ctypes
import re
from pathlib import Path

import numpy as np

from quadjax.core.files import write_bytes
from quadjax.export.compiler import host
from quadjax.export.conversion import Converted
from quadjax.export.library import EXACT, VEHICLE, pointers
from quadjax.flights.flight import Signal

HERE = Path(__file__).parent
SYSTEM = ("stdbool.h", "stddef.h", "stdint.h", "math.h")


def sources_of(converted: Converted, folder: Path) -> tuple[list[Path], list[str]]:
    """Write the C of a target; what is compiled, and the options.

    Headers of the firmware are empty: the stand-in has what they declare.
    """
    target = converted.target
    for name, data in converted.files.items():
        write_bytes(folder / name, data)
    include, headers = folder / target.folder, folder / "stand_in"
    files = [HERE / f"{target.glue}.c", *sorted(include.glob("qj_*.c"))]
    if target.glue == "indiflight":  # its build has two files, one of which is the glue
        files = [files[0], include / "neural_network.c"]
    for path in include.glob("*.[ch]"):
        for name in re.findall(r"#include [<\"](.+)[>\"]", path.read_text("utf-8")):
            if name not in SYSTEM and not (include / name).exists():
                exists = (include / Path(name).name).exists()
                text = f"#include <{Path(name).name}>\n" if exists else ""
                write_bytes(headers / name, text.encode())
    return files, [f"-I{include}", f"-I{headers}", f"-I{HERE}", EXACT, "-lm"]


class Firmware:
    """The glue of a target with its policy, in a stand-in for its firmware: an ``Autopilot``.

    It is called as often as its firmware does, with the newest state, between those of the drone.

    Attributes:
        wrong: why the policy does not fly; None if it does.
        armed: whether the autopilot allowed arming at the last call.
    """

    label = "the glue"

    def __init__(self, converted: Converted, folder: Path, options: tuple[str, ...] = ()) -> None:
        files, of_glue = sources_of(converted, folder)
        options = ("-shared", "-fPIC", *options, *of_glue)
        self._library = ctypes.CDLL(str(host().build(files, folder / "glue.so", options)))
        self._library.firmware_start.restype = ctypes.c_char_p
        wrong = self._library.firmware_start()
        self.wrong, self.armed, self._call = wrong and wrong.decode(), False, 0
        self._period_us = 1e6 / converted.frequency
        self._rates = converted.policy.vehicle == "rate"
        self.files = converted.target.glue

    def call(self, now_us: int, vehicle: np.ndarray | None, flies: bool = True) -> np.ndarray:
        """The command (4,) float32 of one call."""
        command = np.zeros(4, np.float32)
        place = None if vehicle is None else pointers(vehicle)[0]
        flags = (ctypes.c_uint32(now_us % 2**32), place, int(flies), *pointers(command))
        self.armed = bool(self._library.firmware_call(*flags))
        return command

    def begin(self) -> None:
        """A race begins with the next call."""
        self.call(0, np.zeros((), VEHICLE), flies=False)
        self._call = 0

    def step(self, now_us: int, vehicle: np.ndarray | None) -> tuple[int, np.ndarray]:
        """The calls up to a time; the status of a pilot that flies, or of one without a state."""
        command = np.zeros(4, np.float32)
        while vehicle is not None and self._call * self._period_us <= now_us + 1:
            command = self.call(round(self._call * self._period_us), vehicle)
            self._call += 1
        return (1 if command.any() else 3), command

    def counts(self) -> dict[str, int]:
        """What was wrong."""
        return {}

    def outside(self) -> list[str]:
        """Inputs outside their range, which the glue does not tell."""
        return []

    def signals(self) -> dict[str, Signal]:
        """What it logs: nothing."""
        return {}
