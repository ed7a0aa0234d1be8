"""Residuals of other projects: PyTorch state dicts, C arrays."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadjax.config.schema import Vehicle
from quadjax.core.errors import InputError
from quadjax.policy.c_arrays import is_c, read_c_network
from quadjax.policy.torch_files import Layers, linear_layers, read_state_dict
from quadjax.vehicle.residual import Residual, check_shape, from_arrays


def residual_of(vehicle: Vehicle, networks: Sequence[Path | str], sign: int | None) -> Residual:
    """A residual from the networks of thrust and moment, over the propeller speeds of a vehicle.

    Raises:
        InputError: as ``import_residual``; a vehicle without propeller speeds, or no sign.
    """
    if sign is None:
        raise InputError("--thrust-sign is missing, allowed: 1 (added) or -1 (subtracted)")
    constants = vehicle.constants
    if "rpm_min" not in constants:
        raise InputError(f"vehicle.model is {vehicle.model}, expected motor")
    thrust, moment = networks
    return import_residual(thrust, moment, (constants["rpm_min"], constants["rpm_max"]), sign)


def import_residual(
    thrust: Path | str,
    moment: Path | str,
    rpm_range: tuple[float, float],
    thrust_sign: int,
) -> Residual:
    """A residual from two networks with ReLU: PyTorch state dicts of linear layers, or C source.

    Args:
        thrust: network of 7 inputs and 1 output; see ``quadjax.vehicle.residual``.
        moment: network of 10 inputs and 3 outputs.
        rpm_range: propeller speeds that enter as -1 and 1, rpm.
        thrust_sign: +1 if the first network's output is added to the body-z specific force, -1 if
            it is subtracted, as printed in the paper.

    Raises:
        InputError: a file that cannot be read, or networks of other sizes; in one line.
    """
    meta = {"rpm_min": rpm_range[0], "rpm_max": rpm_range[1], "thrust_sign": thrust_sign}
    arrays: dict[str, np.ndarray] = {}
    for name, path in (("thrust", thrust), ("moment", moment)):
        layers = _c_layers(path) if is_c(path) else linear_layers(path, read_state_dict(path))
        check_shape(path, name, layers)
        for index, (kernel, bias) in enumerate(layers):
            arrays |= {f"{name}_kernel_{index}": kernel, f"{name}_bias_{index}": bias}
    return from_arrays(thrust, arrays, meta)


def _c_layers(path: Path | str) -> Layers:
    network = read_c_network(path)
    if network.activation == "tanh":
        raise InputError(f"{path}: its activation is tanh, a residual has relu")
    return network.layers
