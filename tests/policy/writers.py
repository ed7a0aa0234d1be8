"""Networks as C arrays, and what they compute."""

from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np

import quadjax


def squares(step: quadjax.Step) -> list[jax.Array]:
    """The squares of the actuators' states."""
    return [1e-6 * x**2 for x in jax.tree.leaves(step.drone.actuators)]


OF_ROTORS = quadjax.ObservedField("squares", 4, "", "body", value=squares, by_rotor=True)


def linear(sizes: tuple[int, ...], seed: int = 0) -> dict[str, np.ndarray]:
    """Linear layers of a ``Sequential`` with activations between them, as a state dict."""
    random, arrays = np.random.default_rng(seed), {}
    for index, (inputs, outputs) in enumerate(zip(sizes, sizes[1:], strict=False)):
        arrays[f"{2 * index}.weight"] = random.normal(size=(outputs, inputs))
        arrays[f"{2 * index}.bias"] = random.normal(size=outputs)
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def c_source(arrays: Mapping[str, np.ndarray], prefix="", std="", flat=True, body="relu(x);"):
    """The layers of ``linear`` as C arrays, row by row per output, and a function."""
    lines = ["// weights_fake[2] = {1, 2};", '#include "header.h"']
    for number in range(1, len(arrays) // 2 + 1):
        weight, bias = arrays[f"{2 * number - 2}.weight"], arrays[f"{2 * number - 2}.bias"]
        rows = [", ".join(f"{x:.9g}f" for x in row) for row in weight]
        inner = ", ".join(rows) if flat else ", ".join(f"{{{row}}}" for row in rows)
        shape = "[]" if flat else f"[{weight.shape[0]}][{weight.shape[1]}]"
        lines.append(f"static const float {prefix}weights_fc{number}{shape} = {{{inner}}};")
        numbers = ", ".join(f"{x:.9g}" for x in bias)
        lines.append(f"const float {prefix}biases_fc{number}[{len(bias)}] = {{\n{numbers},\n}};")
    if std:
        lines.append(f"const float output_std[4] = {std};")
    return "\n".join([*lines, f"void f() {{ {prefix}{body} }}"])


AUTHORS_FILES = {  # sizes of the layers, and the beginning of the names in C
    "E2Enet/neural_network.c": ((24, 8, 4), ""),
    "c_code/neural_network.c": ((17, 8, 4), ""),
    "nn_thrust.c": ((7, 8, 1), "nn_thrust_"),
    "nn_moment.c": ((10, 8, 3), "nn_moment_"),
}
CONTROLLER = """#include "nn_controller.h"
const float output_std[4] = {
    0.1,
    0.2, // of the second
    0.3,
    0.4,
};
const float gate_pos[NUM_GATES][3] = { {2.0, -1.5, -1.5}, };
void nn_control(const float world_state[16], float rpms[4]) {
    float pos[3] = {world_state[0], world_state[1], world_state[2]};
}
"""


def write_authors_files() -> list[dict[str, np.ndarray]]:
    """C as the authors of the paper publish it, in the current folder; the arrays of each file."""
    networks = []
    for name, (sizes, prefix) in AUTHORS_FILES.items():
        file = Path(name)
        file.parent.mkdir(exist_ok=True)
        networks.append(linear(sizes))
        file.write_text(c_source(networks[-1], prefix))
        if not prefix:
            file.with_name("nn_controller.c").write_text(CONTROLLER)
    return networks


def forward(arrays: Mapping[str, np.ndarray], x: np.ndarray, names="02", activation=np.tanh):
    """The output of a network in NumPy, from its PyTorch arrays."""
    for index, name in enumerate(names):
        x = x @ arrays[f"{name}.weight"].T.astype(float) + arrays[f"{name}.bias"]
        x = activation(x) if index < len(names) - 1 else x
    return x


def relu(x: np.ndarray) -> np.ndarray:
    """The rectifier."""
    return np.maximum(x, 0.0)
