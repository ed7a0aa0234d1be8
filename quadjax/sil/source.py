"""The exported C of a policy, compiled for this machine and called state by state."""

import ctypes

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.conversion import Converted
from quadjax.export.verify.autopilot import build_autopilot
from quadjax.export.verify.build import HOST, Sources, pointers
from quadjax.export.verify.result import Failed, Skipped
from quadjax.export.words import COMMANDS
from quadjax.plant.config import PlantConfig

SAME_LOOP = 0.03  # largest relative difference of the loop rates of plant and autopilot
COUNTED = ("nan steps", "clipped steps", "outside steps")  # by the C, in a race


def at_rate(plant: PlantConfig, sources: Sources) -> PlantConfig:
    """The plant at the loop rate of an autopilot, if the two differ by at most ``SAME_LOOP``.

    The estimators and filters of the C are made for the rate of its calls.
    """
    ratio = 1e9 / sources.call_ns / plant.control_rate
    if abs(ratio - 1.0) > SAME_LOOP or ratio == 1.0:
        return plant
    rates = {name: ratio * getattr(plant, name) for name in ("sample_rate", "control_rate")}
    return plant.replace(**rates)


class ExportedC:
    """The C that a target flies, with its glue in a stand-in for its firmware.

    The glue is called at its own rate, or the nearest with a whole number of calls per state, or of
    states per call. Firmware without glue calls the pilot at every state.

    Attributes:
        label: for the table.
        files: the names of the files that fly.
    """

    def __init__(self, converted: Converted, sources: Sources, rate: float) -> None:
        """Compile and load it.

        Args:
            converted: the policy.
            sources: the C, as the converter writes it.
            rate: of the states, Hz.

        Raises:
            InputError: no compiler, C that does not compile, or a glue or a pilot that rejects the
                policy.
        """
        target, folder = sources.target, sources.folder
        ratio = 1e9 / sources.call_ns / rate if target.glue else 1.0
        calls = round(ratio) if ratio >= 1.0 else 1.0 / round(1.0 / ratio)
        call_ns = round(1e9 / (rate * calls))
        if not target.glue:
            sources = Sources(target, folder, call_ns)
        options, output = [f"-DFIRMWARE_CALL_NS={call_ns}U"], folder / "autopilot.so"
        try:
            build_autopilot(sources, output, [HOST / "sil.c"], options)
        except (Skipped, Failed) as error:
            raise InputError(f"the C cannot be compiled: {error}") from None
        self._library = ctypes.CDLL(str(output))
        self._library.sil_load.restype = ctypes.c_char_p
        if wrong := self._library.sil_load():
            raise InputError(f"{converted.file}: the policy cannot fly here: {wrong.decode()}")
        estimator = ", its own estimator" * self._library.sil_own_estimator()
        sampled = ", sampled actions" * (converted.fixed.noise is not None)
        self.label = f"exported C{estimator}{sampled}"
        flying = ",".join(path.name for path in sources.flying)
        self.files = f"{converted.options.name}.qjp, {target.folder}/{{{flying}}}"
        self.files += f", in the glue of {target.autopilot}" if target.glue else ""

    def begin(self) -> None:
        """A race begins with the next state."""
        self._library.sil_begin()

    def step(self, time: float, state: np.ndarray) -> np.ndarray:
        """The command (4,) float32 for a state, a ``VEHICLE``.

        Args:
            time: of the state since the start of the race, s.
            state: without rpm and the autopilot's own commands, which follow from the rest.

        Returns:
            Rotor speeds in rad/s, rates and specific thrust, or motor commands.
        """
        command = np.zeros(COMMANDS, np.float32)
        self._library.sil_step(ctypes.c_double(time), *pointers(state, command))
        return command

    def counts(self) -> dict[str, int]:
        """Steps of this race in which something was wrong with the state."""
        steps = np.zeros(len(COUNTED), np.uint32)
        self._library.sil_counts(*pointers(steps))
        return dict(zip(COUNTED, steps.tolist(), strict=True))
