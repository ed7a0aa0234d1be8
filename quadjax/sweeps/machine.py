"""How many workers and how many runs at once suit a machine."""

import dataclasses
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

from quadjax.core.errors import InputError
from quadjax.core.files import write_json

CALIBRATION = "calibration.json"
PROBE = "import jax; d = jax.local_devices(); print(d[0].platform, len(d))"


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where trials run."""

    workers: int
    lanes: int  # runs that one worker trains at once in one program
    cores: tuple[int | None, ...]  # of each worker; None: not pinned
    accelerators: tuple[int | None, ...]  # of each worker; None: the CPU
    why: str


def own_cores() -> list[int]:
    """Numbers of the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def accelerator_count() -> int:
    """GPUs that JAX finds; asked in a process of its own, which gives their memory back."""
    names = ("jax_cuda12_plugin", "jax_cuda13_plugin", "jax_rocm60_plugin", "jax_rocm7_plugin")
    if not any(importlib.util.find_spec(name) for name in names):
        return 0
    done = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True)
    words = done.stdout.split()
    return int(words[1]) if done.returncode == 0 and words[0] != "cpu" else 0


def choose_layout(workers: int | None, lanes: int | None, directory: Path, seeds: int) -> Layout:
    """The layout asked for, or what was measured to be fastest.

    Args:
        workers: asked for; None: one for each core, or for each GPU.
        lanes: asked for; None: what the calibration in ``directory`` found, else 1 on a CPU, where
            one process for each core was measured to be faster (docs/design/sweeps.md).
        directory: of the sweep.
        seeds: of a trial.

    Raises:
        InputError: more workers than cores.
    """
    cores, gpus = own_cores(), accelerator_count()
    known = read_calibration(directory)
    most = len(cores)
    if workers is not None and workers > most:
        raise InputError(
            f"--workers is {workers}, but this process may use {most} cores; allowed: 1 to {most}"
        )
    if gpus:
        count = workers or gpus
        chosen = lanes or (known or {}).get("lanes") or 0
        return Layout(
            count, chosen, (None,) * count, tuple(i % gpus for i in range(count)), f"{gpus} GPUs"
        )
    why = "one worker for each core"
    if known is not None and workers is None and lanes is None:
        workers, lanes, why = known["workers"], known["lanes"], f"measured in {CALIBRATION}"
    count = min(workers or most, most)
    pinned = tuple(cores[:count])
    return Layout(count, lanes or 1, pinned, (None,) * count, why)


def read_calibration(directory: Path) -> dict[str, int] | None:
    """What ``--calibrate`` found fastest here, if it ran."""
    path = directory / CALIBRATION
    if not path.is_file():
        return None
    found = json.loads(path.read_text(encoding="utf-8"))
    return found["fastest"] if found["cores"] == len(own_cores()) else None


def write_calibration(directory: Path, rows: list[dict[str, object]]) -> dict[str, object]:
    """Keep measured speeds; returns the fastest row."""
    fastest = max(rows, key=lambda row: row["runs_steps_per_second"])
    write_json(
        directory / CALIBRATION, {"cores": len(own_cores()), "rows": rows, "fastest": fastest}
    )
    return fastest
