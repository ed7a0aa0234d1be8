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


def history(fields: str, every: int) -> str:
    """The override for two earlier steps of fields."""
    return f"observation.history={{fields: [{fields}], steps: 2, every: {every}}}"


LAYOUTS = {  # preset, overrides
    "e2e with a history": (
        "e2e +disturbance",
        (history("position, velocity, attitude, rates, rpm, last_action", 9),),
    ),
    "racing, axes and more": ("e2e", (*FIVE_INCH, AXES, *MORE)),
    "e2e, axes and more": ("e2e +disturbance", (AXES, *MORE, "battery.charge=[0.1, 1.0]")),
    "published racing": ("e2e", FIVE_INCH),
    "published e2e": ("e2e +disturbance", ()),
    "published indi": ("indi", ()),
    "e2e with quaternions": ("e2e +disturbance", ("vehicle.quaternion=true",)),
    "racing with a history": (
        "e2e",
        (*FIVE_INCH, AXES, LAST, history("position, rotation, rates, rotor_speed, last_action", 2)),
    ),
    "indi with a history": (
        "indi",
        (history("position, velocity, rates, thrust, last_action", 3),),
    ),
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
    """States (n, size) float32 of the fields that a header declares, from a fixed seed."""
    body = header[: header.index("_state;")].rpartition("typedef struct {")[2]
    rng = np.random.default_rng(0)
    parts = []
    for name, size in re.findall(r"float (\w+)(?:\[(\d+)\])?;", body):
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
#include "{name}_race.h"
void commands(const float *states, {kind} *out, uint32_t count) {{
  {name}_race race;
  {name}_race_start(&race, states, 0);
  for (uint32_t i = 0; i < count; ++i) {{
    (void){name}_race_step(&race, {upper}_SCALAR, (const {name}_state *)(states + i * {upper}_STATE_SIZE),
                           out + i * {upper}_OUTPUTS, 0);
  }}
}}
"""  # noqa: E501


def commands(
    policy: str | Path, folder: Path, options: list[str], run: Callable[..., str]
) -> np.ndarray:
    """Commands (n, 4) of the exported and compiled C, which also passes its self-test."""
    run("export", policy, "--output", folder, "--name", "frozen", *options)
    header = (folder / "frozen_race.h").read_text()
    real = "float command[" in header
    kind = "float" if real else "uint16_t"
    source = folder / "harness.c"
    source.write_text(HARNESS.format(name="frozen", upper="FROZEN", kind=kind))
    files = [source, folder / "frozen.c", folder / "frozen_race.c"]
    library = folder / "frozen.so"
    subprocess.run(["gcc", "-O2", "-shared", "-fPIC", "-o", library, *files], check=True)
    c = ctypes.CDLL(str(library.resolve()))
    if c.frozen_self_test() or c.frozen_race_self_test():
        raise RuntimeError(f"{policy}: the self-test of the C fails")
    states = random_states(header)
    out = np.zeros((len(states), 4), np.float32 if real else np.uint16)
    pointer = ctypes.c_void_p
    c.commands(states.ctypes.data_as(pointer), out.ctypes.data_as(pointer), len(states))
    return out
