"""C around the exported C: test harness, float version, main function of Frama-C, memory."""

from pathlib import Path

from quadjax.export import battery_tables
from quadjax.export.emit import names_of
from quadjax.export.estimator_tables import FINE_BITS
from quadjax.export.render import render
from quadjax.export.verify.folder import Folder


def write_harness(folder: Folder, work: Path) -> Path:
    """Functions that process many vectors in a call, with a ``main`` under -DHARNESS_MAIN."""
    return _write(work / "harness.c", _common(folder))


def write_memory(work: Path) -> Path:
    """``memset`` and ``memcpy``, which a compiler may call where there is no C library."""
    return _write(work / "memory.c", {})


def write_startup(work: Path) -> Path:
    """The vector table and the first instructions of a Cortex-M board."""
    return _write(work / "startup.c", {})


def write_float(folder: Folder, work: Path) -> Path:
    """The policy in float32 C, as written by hand: the reference of error and of speed."""
    policy = folder.policy
    layers = [{"kernel": kernel, "bias": bias} for kernel, bias in policy.layers]
    values = {
        "layers": layers,
        "widest": max(len(layer["bias"]) for layer in layers),
        "inputs": folder.network.inputs,
        "low": policy.command_low,
        "span": 0.5 * (policy.command_high - policy.command_low),
    }
    return _write(work / "float.c", values)


def write_loop(folder: Folder, work: Path) -> Path:
    """INDIflight's controller for many drones."""
    path = work / "loop.c"
    path.write_text(render("indiflight/loop.c", {"name": folder.name}))
    return path


def write_indiflight_eva(folder: Folder, work: Path) -> Path:
    """Calls of INDIflight's functions for any state and any memory of the controller."""
    path = work / "indiflight_eva.c"
    path.write_text(render("indiflight/eva_main.c", _common(folder)))
    return path


def write_eva_main(folder: Folder, work: Path) -> Path:
    """Calls of all exported functions for any input and any memory, with assertions."""
    network = folder.network
    unit = 2.0**network.fraction_bits
    ends = zip(network.command_low / unit, network.command_high / unit, strict=True)
    number = "{:.0f}".format if network.rpm else repr
    values = _common(folder) | {
        "limits": [tuple(number(float(end)) for end in pair) for pair in ends],
        "states": folder.race.state_size,
        "memory": 2**FINE_BITS,
        "battery_memory": 2**battery_tables.FINE_BITS,
    }
    return _write(work / "eva_main.c", values)


def _common(folder: Folder) -> dict[str, object]:
    own = {"estimator": folder.estimator, "race": folder.race, "battery": folder.battery}
    return names_of(folder.network, folder.name) | own


def _write(path: Path, values: dict[str, object]) -> Path:
    path.write_text(render(path.name, values))
    return path
