"""The C around the C: a harness that runs batches, a float version to compare with, main files."""

import ctypes
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadjax.export.render import fill
from quadjax.export.verify.folder import Folder
from quadjax.export.verify.machine import Machine
from quadjax.export.verify.toolchain import Compiler

ROW = 7  # commands, trace, clipped, NaN
CHUNK = 20_000  # vectors that go into the emulated machine at a time

ESTIMATOR_BATCH = """
void harness_estimate(const float *measurements, float *out, uint32_t count);
void harness_estimate(const float *measurements, float *out, uint32_t count) {
  @name@_estimator estimator = {{0}, {0}, 0U};
  for (uint32_t i = 0U; i < count; ++i) {
    (void)@name@_estimator_update(&estimator, (const @name@_measurement *)measurements, out,
                                  out + 3);
    measurements += 13;
    out += 6;
  }
}
"""
ESTIMATOR_STEP = """\
  static @name@_estimator estimator;
  float moment[3];
  float force[3];
  (void)@name@_estimator_update(&estimator, (const @name@_measurement *)x, moment, force);
"""
MEMORY = """
#include <stddef.h>
/* What a compiler may call where there is no C library, by its own and by the ARM ABI's names. */
void *memset(void *to, int value, size_t size);
void *memcpy(void *restrict to, const void *restrict from, size_t size);
void *memset(void *to, int value, size_t size) {
  volatile unsigned char *byte = to;
  while (size-- != 0U) {
    *byte++ = (unsigned char)value;
  }
  return to;
}
void *memcpy(void *restrict to, const void *restrict from, size_t size) {
  volatile unsigned char *byte = to;
  const unsigned char *source = from;
  while (size-- != 0U) {
    *byte++ = *source++;
  }
  return to;
}
#define ABI(suffix)                                                                     \\
  void __aeabi_memclr##suffix(void *to, size_t size);                                   \\
  void __aeabi_memset##suffix(void *to, size_t size, int value);                        \\
  void __aeabi_memcpy##suffix(void *to, const void *from, size_t size);                 \\
  void __aeabi_memclr##suffix(void *to, size_t size) { memset(to, 0, size); }           \\
  void __aeabi_memset##suffix(void *to, size_t size, int value) { memset(to, value, size); } \\
  void __aeabi_memcpy##suffix(void *to, const void *from, size_t size) { memcpy(to, from, size); }
ABI()
ABI(4)
ABI(8)
"""


def write_harness(folder: Folder, work: Path) -> Path:
    """The batch functions, with a ``main`` under -DHARNESS_MAIN."""
    motor = folder.estimator is not None
    values = {
        "name": folder.name,
        "NAME": folder.name.upper(),
        "command_type": "uint16_t" if folder.policy.vehicle == "motor" else "float",
        "estimator_include": f'#include "{folder.name}_estimator.h"\n' if motor else "",
        "estimator_batch": ESTIMATOR_BATCH.replace("@name@", folder.name) if motor else "",
        "estimator_step": ESTIMATOR_STEP.replace("@name@", folder.name) if motor else "",
        "estimator_test": f" + {folder.name}_estimator_self_test()" if motor else "",
    }
    path = work / "harness.c"
    path.write_text(fill("harness.c.in", values))
    return path


def write_memory(work: Path) -> Path:
    """``memset`` and ``memcpy``, which a compiler may call where there is no C library."""
    path = work / "memory.c"
    path.write_text(MEMORY)
    return path


@dataclasses.dataclass
class HostLibrary:
    """The C as a shared library of this process."""

    library: ctypes.CDLL
    folder: Folder

    def _call(self, name: str, *arguments: object) -> int:
        words = [
            a.ctypes.data_as(ctypes.c_void_p) if isinstance(a, np.ndarray) else ctypes.c_uint32(a)
            for a in arguments
        ]
        function = getattr(self.library, name)
        function.restype = ctypes.c_uint32
        return int(function(*words))

    def infer(self, x: np.ndarray, kernel: int = 0) -> np.ndarray:
        """Rows (n, 7) int32 of observations (n, inputs)."""
        x = np.ascontiguousarray(x, np.float32)
        out = np.zeros((len(x), ROW), np.int32)
        self._call("harness_infer", kernel, x, out, len(x))
        return out

    def command(self, x: np.ndarray) -> np.ndarray:
        """What the forward function gives (n, 4)."""
        x = np.ascontiguousarray(x, np.float32)
        kind = np.uint16 if self.folder.policy.vehicle == "motor" else np.float32
        out = np.zeros((len(x), 4), kind)
        self._call("harness_command", 0, x, out, len(x))
        return out

    def observe(self, states: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Rows (n, inputs + 3) int32 of states and targets."""
        states = np.ascontiguousarray(states, np.float32)
        out = np.zeros((len(states), self.folder.network.inputs + 3), np.int32)
        self._call(
            "harness_observe", states, np.ascontiguousarray(targets, np.uint32), out, len(states)
        )
        return out

    def events(self, positions: np.ndarray, target: int) -> np.ndarray:
        """Rows (n, 2): event and target along positions (n, 3)."""
        positions = np.ascontiguousarray(positions, np.float32)
        out = np.zeros((len(positions), 2), np.uint32)
        self._call("harness_events", positions, target, out, len(positions))
        return out

    def estimate(self, measurements: np.ndarray) -> np.ndarray:
        """Moments and forces (n, 6) along measurements (n, 13)."""
        measurements = np.ascontiguousarray(measurements, np.float32)
        out = np.zeros((len(measurements), 6), np.float32)
        self._call("harness_estimate", measurements, out, len(measurements))
        return out

    def self_test(self) -> int:
        """Mismatches of the network's self-test."""
        return self._call(f"{self.folder.name}_self_test")


def load_library(
    compiler: Compiler, sources: Sequence[Path], output: Path, extra: Sequence[str] = ()
) -> ctypes.CDLL:
    """Build C that needs no C library for this machine, and load it."""
    words, sources = ["-shared", "-fPIC", *extra], list(sources)
    if compiler.name == "zig cc" and sys.platform == "linux":
        # Otherwise it would first build parts of a C library, which takes it seconds.
        words.append("-nostdlib")
        sources.append(write_memory(output.parent))
    return ctypes.CDLL(str(compiler.build(sources, output, words)))


def host_library(folder: Folder, compiler: Compiler, work: Path) -> HostLibrary:
    """Build the folder's C for this machine and load it."""
    sources = [*folder.files, write_harness(folder, work)]
    library = load_library(compiler, sources, work / "host.so", [f"-I{folder.path}"])
    return HostLibrary(library, folder)


def machine_infer(machine: Machine, kernel: int, x: np.ndarray) -> np.ndarray:
    """Rows (n, 7) int32 of observations (n, inputs), on the emulated processor."""
    rows = []
    for start in range(0, len(x), CHUNK):
        part = np.ascontiguousarray(x[start : start + CHUNK], np.float32)
        machine.release()
        source = machine.place(part)
        target = machine.reserve(len(part) * ROW * 4)
        machine.call("harness_infer", kernel, source, target, len(part))
        rows.append(machine.read(target, np.int32, (len(part), ROW)))
    return np.concatenate(rows)
