"""Files in the formats of PyTorch, Stable-Baselines3 and C, written without any of them."""

import io
import json
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

STORAGE = {"float32": b"FloatStorage", "float64": b"DoubleStorage", "int64": b"LongStorage"}
ORDERED_DICT = b"ccollections\nOrderedDict\n)R"


def _text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def _integer(value: int) -> bytes:
    return b"J" + struct.pack("<i", value)


def _tuple(values: tuple[int, ...]) -> bytes:
    return b"(" + b"".join(map(_integer, values)) + b"t"


def tensor(array: np.ndarray, key: str, size=None, stride=None, offset=0, count=None) -> bytes:
    """Pickle opcodes of a tensor; the shape and the storage's size may be wrong."""
    strides = tuple(step // array.itemsize for step in array.strides)
    storage = b"(" + _text("storage") + b"ctorch\n" + STORAGE[str(array.dtype)] + b"\n"
    storage += _text(key) + _text("cpu") + _integer(array.size if count is None else count) + b"tQ"
    shape = _tuple(array.shape if size is None else size) + _tuple(stride or strides)
    rest = b"\x89" + ORDERED_DICT
    return (
        b"ctorch._utils\n_rebuild_tensor_v2\n(" + storage + _integer(offset) + shape + rest + b"tR"
    )


def archive(pickled: bytes, storages: Mapping[str, bytes]) -> bytes:
    """The zip archive of one ``torch.save``, with a pickle and raw numbers."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        file.writestr("archive/data.pkl", pickled)
        file.writestr("archive/byteorder", "little")
        for key, data in storages.items():
            file.writestr(f"archive/data/{key}", data)
        file.writestr("archive/version", "3\n")
    return stream.getvalue()


def state_dict(arrays: Mapping[str, np.ndarray], **wrong: object) -> bytes:
    """What ``torch.save`` writes of a state dict."""
    items = b"".join(
        _text(name) + tensor(array, str(key), **wrong)
        for key, (name, array) in enumerate(arrays.items())
    )
    pickled = b"\x80\x02" + ORDERED_DICT + b"(" + items + b"u."
    return archive(pickled, {str(k): a.tobytes() for k, a in enumerate(arrays.values())})


def linear(sizes: tuple[int, ...], seed: int = 0, prefix: str = "") -> dict[str, np.ndarray]:
    """Linear layers of a ``Sequential`` with activations between them, as a state dict."""
    random, arrays = np.random.default_rng(seed), {}
    for index, (inputs, outputs) in enumerate(zip(sizes, sizes[1:], strict=False)):
        arrays[f"{prefix}{2 * index}.weight"] = random.normal(size=(outputs, inputs))
        arrays[f"{prefix}{2 * index}.bias"] = random.normal(size=outputs)
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def sb3_tensors(inputs: int = 24, actions: int = 4) -> dict[str, np.ndarray]:
    """The state dict of Stable-Baselines3's ``MlpPolicy`` with separate networks."""
    extractor = "mlp_extractor."
    heads = linear((8, actions), 3, "action_net."), linear((6, 1), 4, "value_net.")
    arrays = {"log_std": np.linspace(-2, -1, actions, dtype=np.float32)}
    arrays |= linear((inputs, 7, 8), 1, extractor + "policy_net.")
    arrays |= linear((inputs, 5, 6), 2, extractor + "value_net.")
    for head in heads:  # a single layer, without a number
        arrays |= {name.replace(".0.", "."): array for name, array in head.items()}
    return arrays


def sb3_model(path: Path, arrays: Mapping[str, np.ndarray], data: object) -> Path:
    """A model of Stable-Baselines3: a zip archive with a state dict and JSON."""
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("data", json.dumps(data))
        file.writestr("policy.pth", state_dict(arrays))
        file.writestr("_stable_baselines3_version", "2.3.0")
    return path


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
