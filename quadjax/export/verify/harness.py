"""The C around the C: a harness that runs batches, a float version to compare with, main files."""

import ctypes
import dataclasses
from pathlib import Path

import numpy as np

from quadjax.export.render import fill, wrapped
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


def write_float(folder: Folder, work: Path) -> Path:
    """The policy in float32 C, as one would write it by hand: the measure of error and speed."""
    tables, calls, widest = [], [], folder.network.inputs
    source = "x"
    for index, (kernel, bias) in enumerate(folder.policy.layers):
        rows, columns = kernel.shape[1], kernel.shape[0]
        widest = max(widest, rows)
        for name, values in (("w", kernel.T), ("b", bias)):
            numbers = wrapped(f"{float(v)!r}F" for v in np.ravel(values))
            tables.append(f"static const float {name}{index}[{values.size}] = {{\n{numbers}}};")
        target = ("a", "b")[index % 2]
        relu = int(index < len(folder.policy.layers) - 1)
        calls.append(f"  layer(w{index}, b{index}, {rows}, {columns}, {source}, {target}, {relu});")
        source = target
    squash = {
        "clip": "a < -1.0F ? -1.0F : (a > 1.0F ? 1.0F : a)",
        "tanh": "tanhf(a)",
    }[folder.policy.output]
    low, high = folder.policy.command_low, folder.policy.command_high
    ends = [
        f"static const float {name}[4] = {{{', '.join(f'{float(v)!r}F' for v in values)}}};"
        for name, values in (("low", low), ("span", 0.5 * (high - low)))
    ]
    text = FLOAT.replace("<tables>", "\n".join([*tables, *ends])).replace("<widest>", str(widest))
    text = text.replace("<calls>", "\n".join(calls)).replace("<source>", source)
    text = text.replace("<inputs>", str(folder.network.inputs)).replace("<squash>", squash)
    include = "#include <math.h>\n" if folder.policy.output == "tanh" else ""
    path = work / "float.c"
    path.write_text(include + text)
    return path


FLOAT = """\
<tables>
static void layer(const float *w, const float *b, int rows, int columns, const float *x, float *y,
                  int relu) {
  for (int row = 0; row < rows; ++row) {
    float sum = b[row];
    for (int column = 0; column < columns; ++column) {
      sum += w[row * columns + column] * x[column];
    }
    y[row] = (relu && sum < 0.0F) ? 0.0F : sum;
  }
}

void float_forward(const float *x, float *command);
void float_forward(const float *x, float *command) {
  float a[<widest>];
  float b[<widest>];
<calls>
  (void)a;
  (void)b;
  for (int i = 0; i < 4; ++i) {
    const float *const last = <source>;
    const float value = last[i];
    const float a = value;
    command[i] = low[i] + span[i] * ((<squash>) + 1.0F);
  }
}

void float_batch(const float *x, float *command, unsigned count);
void float_batch(const float *x, float *command, unsigned count) {
  for (unsigned i = 0; i < count; ++i) {
    float_forward(x + i * <inputs>, command + i * 4);
  }
}
"""


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


def host_library(folder: Folder, compiler: Compiler, work: Path) -> HostLibrary:
    """Build the folder's C for this machine and load it."""
    sources = [*folder.files, write_harness(folder, work)]
    output = work / "host.so"
    compiler.build(sources, output, ["-shared", "-fPIC", f"-I{folder.path}"])
    return HostLibrary(ctypes.CDLL(str(output)), folder)


def float_library(folder: Folder, compiler: Compiler, work: Path) -> ctypes.CDLL:
    """The float version for this machine, without fused or reordered arithmetic."""
    output = work / "float.so"
    extra = ["-shared", "-fPIC", "-ffp-contract=off", "-lm"]
    compiler.build([write_float(folder, work)], output, extra)
    return ctypes.CDLL(str(output))


def float_commands(library: ctypes.CDLL, x: np.ndarray) -> np.ndarray:
    """Commands (n, 4) float32 of the float version."""
    x = np.ascontiguousarray(x, np.float32)
    out = np.zeros((len(x), 4), np.float32)
    library.float_batch(
        x.ctypes.data_as(ctypes.c_void_p), out.ctypes.data_as(ctypes.c_void_p), len(x)
    )
    return out


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
