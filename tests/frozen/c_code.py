"""Exported C in random states: the one place that knows which functions the C has."""

import ctypes
import subprocess
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

import quadjax
from quadjax.export.library import VEHICLE

COUNT = 5_000
SPREADS = {
    "position": 6.0,
    "velocity": 3.0,
    "rates": 4.0,
    "specific_force": 10.0,
    "body_velocity": 3.0,
    "autopilot_command": 0.0,
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


def random_states() -> np.ndarray:
    """States (n,) of ``qj_vehicle`` from a fixed seed."""
    rng, states = np.random.default_rng(0), np.zeros(COUNT, VEHICLE)
    for name, spread in SPREADS.items():
        states[name] = rng.uniform(-1.0, 1.0, states[name].shape) * spread
    turned = rng.standard_normal((COUNT, 4))
    states["quaternion"] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    states["rotor_speed"] = rng.uniform(300.0, 1150.0, (COUNT, 4))
    states["thrust"] = rng.uniform(0.0, 15.0, COUNT)
    states["time_us"] = states["position_us"] = 1953 * np.arange(1, COUNT + 1)
    return states


HARNESS = """
#include "qj_pilot.h"
#include "frozen.h"
int commands(const qj_vehicle *states, float *out, uint32_t count) {
  static qj_pilot pilot;
  if (qj_pilot_start(&pilot, &frozen_policy, QJ_DEFAULT_KERNEL, 512.0F) != 0) {
    return 1;
  }
  for (uint32_t i = 0; i < count; ++i) {
    (void)qj_pilot_call(&pilot, states[i].time_us, states + i, out + 4 * i);
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
    files, library = [source, *header.parent.glob("qj_*.c")], folder / "frozen.so"
    flags = ["-O2", "-ffp-contract=off", "-shared", "-fPIC", f"-I{header.parent}"]
    subprocess.run(["gcc", *flags, "-o", library, *files, "-lm"], check=True)
    c, states = ctypes.CDLL(str(library.resolve())), random_states()
    out, pointer = np.zeros((len(states), 4), np.float32), ctypes.c_void_p
    places = (states.ctypes.data_as(pointer), out.ctypes.data_as(pointer))
    if c.commands(*places, len(states)):
        raise RuntimeError(f"{policy}: the pilot refuses the policy")
    return out
