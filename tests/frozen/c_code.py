"""Exported C in random states: the one place that knows which functions the C has."""

import ctypes
import re
import subprocess
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

import quadjax

COUNT = 5_000
SPREADS = {"position": 6.0, "velocity": 3.0, "rates": 4.0, "attitude": 0.9, "euler": 0.9}
RANGES = {
    "rpm": (3000, 11000),
    "rotor_speed": (0, 3000),
    "thrust": (0, 15),
    "highest_rpm": (9000, 11000),
}
FIVE_INCH = ("vehicle=5inch", "observation.actuator_range=[0, 3000]")
AXES, LAST = "observation.attitude=rotation", "observation.last_action=true"
MORE = ("observation.gates_ahead=2", LAST)
LAYOUTS = {  # preset, overrides
    "racing, axes and more": ("e2e", (*FIVE_INCH, AXES, *MORE)),
    "e2e, axes and more": ("e2e +disturbance", (AXES, *MORE, "battery.charge=[0.1, 1.0]")),
    "published racing": ("e2e", FIVE_INCH),
    "published e2e": ("e2e +disturbance", ()),
    "published indi": ("indi", ()),
    "e2e with quaternions": ("e2e +disturbance", ("vehicle.quaternion=true",)),
    "indi and more": ("indi", ("observation.gates_ahead=3", LAST)),
}
TINY = ("run.devices=1", "run.steps=1", "network.hidden=[8]", "learner.num_envs=16",
        "evaluate.laps=1", "track.generate.seed=1")  # fmt: skip
WIDE = {"position": 64, "velocity": 128, "rates": 1024, "attitude": 4, "last_action": 2}


def with_random_weights(source: Path, target: Path) -> None:
    """A policy file with weights that no training's rounding decides."""
    rng = np.random.default_rng(0)
    with np.load(source) as file:
        arrays = dict(file)
    for name, array in arrays.items():
        if name.startswith(("kernel", "bias")):
            scale = 0.3 / np.sqrt(array.shape[0]) if name.startswith("kernel") else 0.03
            arrays[name] = (scale * rng.standard_normal(array.shape)).astype(np.float32)
    np.savez(target, **arrays)


def cases(shipped: Iterable[str]) -> Iterator[tuple[str, str | Path, list[str]]]:
    """Name, policy and options of ``quadjax export``, of shipped policies and of layouts."""
    for name in shipped:
        yield name, name, []
    for name, (preset, overrides) in LAYOUTS.items():
        config = quadjax.load(preset, [*overrides, *TINY])
        folder = Path("trained") / name.replace(" ", "_").replace(",", "")
        quadjax.train(config, folder, progress=False)
        policy = folder / "random.npz"
        with_random_weights(folder / "policy_last.npz", policy)
        fields = quadjax.Policy.load(policy).layout
        wide = [f"--range={field}={size}" for field, size in WIDE.items() if field in fields]
        yield name, policy, ["--allow-unfinished", *wide]


def random_states(header: str) -> np.ndarray:
    """States (n, size) float32 of the fields that a header lists, from a fixed seed."""
    body = header[header.index("State, as qj_observe takes it") : header.index("Do not edit")]
    rng = np.random.default_rng(0)
    parts = []
    for name, size in re.findall(r"^ \*   (\w+)(?:\[(\d+)\])?  ", body, re.MULTILINE):
        shape = (COUNT, int(size or 1))
        if name in RANGES:
            part = rng.uniform(*RANGES[name], shape)
        elif name == "quaternion":
            part = rng.standard_normal(shape)
            part /= np.linalg.norm(part, axis=1, keepdims=True)
        else:
            part = rng.uniform(-1.0, 1.0, shape) * SPREADS.get(name, 0.01)
        parts.append(part)
    return np.concatenate(parts, axis=1).astype(np.float32)


HARNESS = """
#include "qj.h"
#include "frozen.h"
int commands(const float *states, int32_t *out, uint32_t count, uint32_t *fraction) {
  static qj_policy policy;
  static qj_race race;
  static int32_t q[QJ_MAX_WIDTH];
  const qj_error error = qj_load(&policy, frozen_words, sizeof(frozen_words));
  if (error != QJ_OK) {
    return (int)error;
  }
  *fraction = (policy.kind == QJ_RPM) ? 0U : policy.fraction_bits;
  qj_race_start(&policy, &race, states, 0);
  for (uint32_t i = 0; i < count; ++i) {
    float command[4];
    (void)qj_race_update(&policy, &race, states + i * policy.state_size);
    (void)qj_observe(&policy, race.target, states + i * policy.state_size, q);
    qj_forward(&policy, q, out + 4 * i, 0);
    qj_commands(&policy, out + 4 * i, command);
    for (int k = 0; k < 4 && policy.kind == QJ_RPM; ++k) {
      out[4 * i + k] = (int32_t)command[k];
    }
  }
  return 0;
}
"""


def commands(
    policy: str | Path, folder: Path, options: list[str], run: Callable[..., str]
) -> np.ndarray:
    """Commands (n, 4) of the exported and compiled C, which also passes its self-test."""
    run("export", policy, "--output", folder, "--name", "frozen", *options)
    (header,) = folder.rglob("frozen.h")
    source = folder / "harness.c"
    source.write_text(HARNESS)
    files = [source, *(p for p in header.parent.glob("qj_*.c") if p.name != "qj_angles.c")]
    library = folder / "frozen.so"
    command = ["gcc", "-O2", "-shared", "-fPIC", f"-I{header.parent}", "-o", library, *files]
    subprocess.run(command, check=True)
    c, fraction = ctypes.CDLL(str(library.resolve())), ctypes.c_uint32()
    states = random_states(header.read_text())
    out, pointer = np.zeros((len(states), 4), np.int32), ctypes.c_void_p
    places = (states.ctypes.data_as(pointer), out.ctypes.data_as(pointer))
    if error := c.commands(*places, len(states), ctypes.byref(fraction)):
        raise RuntimeError(f"{policy}: the loader refuses the words: error {error}")
    if not fraction.value:
        return out.astype(np.uint16)
    return (out * np.float32(2.0**-fraction.value)).astype(np.float32)
