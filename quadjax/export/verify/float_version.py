"""The policy in float32 C, as one would write it by hand: the measure of error and of speed."""

import ctypes
from pathlib import Path

import numpy as np

from quadjax.export.render import wrapped
from quadjax.export.verify.folder import Folder
from quadjax.export.verify.harness import load_library
from quadjax.export.verify.toolchain import Compiler


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


def float_library(folder: Folder, compiler: Compiler, work: Path) -> ctypes.CDLL:
    """The float version for this machine, without fused or reordered arithmetic."""
    output, sources = work / "float.so", [write_float(folder, work)]
    if folder.policy.output == "tanh":
        extra = ["-shared", "-fPIC", "-ffp-contract=off", "-lm"]
        return ctypes.CDLL(str(compiler.build(sources, output, extra)))
    return load_library(compiler, sources, output, ["-ffp-contract=off"])


def float_commands(library: ctypes.CDLL, x: np.ndarray) -> np.ndarray:
    """Commands (n, 4) float32 of the float version."""
    x = np.ascontiguousarray(x, np.float32)
    out = np.zeros((len(x), 4), np.float32)
    library.float_batch(
        x.ctypes.data_as(ctypes.c_void_p), out.ctypes.data_as(ctypes.c_void_p), len(x)
    )
    return out
