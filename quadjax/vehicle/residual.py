"""Residual thrust and moment networks on top of the nominal model, and their files.

N_T has seven inputs (four propeller speeds, body velocity) and one output, a specific force in
m/s^2; N_M has ten (the same and the body rates) and three outputs in N m. Propeller speeds enter
scaled to [-1, 1], the others in SI (Ferede et al., arXiv 2311.16948).

A residual file has ``thrust_kernel_0`` (7, n), ``thrust_bias_0`` .., ``moment_kernel_0`` (10, n)
.., and ``meta`` with ``format: "quadjax-residual/1"``, ``rpm_min``, ``rpm_max``, ``thrust_sign``
(+1: added to the body-z specific force; -1: subtracted) and what it was fitted on. A policy file
can hold the same arrays, and the numbers under the key ``residual`` of its ``meta``.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core import mlp
from quadjax.core.errors import InputError, quadjax_command, reading
from quadjax.core.files import read_layers, read_npz, write_npz
from quadjax.core.mlp import Params
from quadjax.core.resources import PRETRAINED
from quadjax.core.vectors import Rotors, Vec3

FORMAT, POLICY_FORMAT = FORMATS = ("quadjax-residual/1", "quadjax-policy/2")
SHAPES = {"thrust": (7, 1), "moment": (10, 3)}


class Residual(struct.PyTreeNode):
    """Parameters of two ``MLP``, the scaling of their inputs and the sign of the first."""

    thrust: Params  # 7 -> .. -> 1
    moment: Params  # 10 -> .. -> 3
    rpm_min: jax.Array  # rpm that enters as -1
    rpm_max: jax.Array  # rpm that enters as +1
    thrust_sign: jax.Array  # +1: added to the body-z specific force; -1: subtracted
    gain: jax.Array | None = None  # factor on all outputs; None, as in files: 1

    def with_gain_in_layers(self) -> "Residual":
        """The same function without a gain."""
        if (gain := self.gain) is None:
            return self

        def scale(params: Params) -> Params:
            *hidden, (kernel, bias) = mlp.to_layers(params)
            return mlp.to_params((*hidden, (gain * kernel, gain * bias)))

        return self.replace(thrust=scale(self.thrust), moment=scale(self.moment), gain=None)


def adds_nothing(residual: Residual) -> bool:
    """Whether every output is zero, as ``quadjax fit`` writes one that it rejects."""
    last = [mlp.to_layers(params)[-1] for params in (residual.thrust, residual.moment)]
    return not any(np.any(x) for x in jax.tree.leaves(last))


def residual_force_moment(
    residual: Residual, rpm: Rotors, body_velocity: Vec3, body_rates: Vec3
) -> tuple[jax.Array, Vec3]:
    """What the networks add to the nominal model, of speeds in rpm, m/s and rad/s, body frame.

    Returns:
        The addition to the body-z specific force (), m/s^2, sign already applied, and to the
        moments, N m.
    """
    residual = residual.with_gain_in_layers()
    span = residual.rpm_max - residual.rpm_min
    scaled_rpm = 2.0 * (rpm.array() - residual.rpm_min) / span - 1.0
    thrust_inputs = jnp.concatenate([scaled_rpm, body_velocity.array()])
    force_z = residual.thrust_sign * mlp.apply(residual.thrust, thrust_inputs)[0]
    moment_inputs = jnp.concatenate([thrust_inputs, body_rates.array()])
    return force_z, Vec3.of(mlp.apply(residual.moment, moment_inputs))


def write_residual(path: Path | str, residual: Residual, source: dict) -> None:
    """Write a residual file atomically; ``source`` describes the data of the fit."""
    arrays, numbers = to_arrays(residual)
    write_npz(path, arrays, {"format": FORMAT, **numbers, "source": source})


def to_arrays(residual: Residual) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """A residual as the arrays and the numbers of a file."""
    arrays: dict[str, np.ndarray] = {}
    residual = residual.with_gain_in_layers()
    for name in SHAPES:
        for index, (kernel, bias) in enumerate(mlp.to_layers(getattr(residual, name))):
            arrays[f"{name}_kernel_{index}"] = np.asarray(kernel, np.float32)
            arrays[f"{name}_bias_{index}"] = np.asarray(bias, np.float32)
    numbers = {key: float(getattr(residual, key)) for key in ("rpm_min", "rpm_max")}
    return arrays, numbers | {"thrust_sign": int(residual.thrust_sign)}


def digest(residual: Residual) -> str:
    """SHA-256 of a residual's numbers as 32-bit floats, whatever file they come from."""
    arrays, numbers = to_arrays(residual)
    content = hashlib.sha256(json.dumps(numbers, sort_keys=True).encode())
    for name in sorted(arrays):
        content.update(f"{name}{arrays[name].shape}".encode())
        content.update(arrays[name].astype("<f4").tobytes())
    return content.hexdigest()


def located(path: Path | str) -> Path:
    """The file of a path, or, of a bare name that is no file, the shipped file of that name."""
    path, shipped = Path(path), PRETRAINED / Path(path).name
    bare = path.parent == Path(".") and not path.exists()
    return shipped if bare and shipped.exists() else path


def is_shipped(path: Path | str) -> bool:
    """Whether a residual comes with the package, by its name."""
    return located(path).parent == PRETRAINED


def read_residual(path: Path | str) -> Residual:
    """Read and check a residual file, a shipped one by its name, or that of a policy file.

    Raises:
        InputError: a missing, damaged or inconsistent file, in one line.
    """
    with reading(path):
        path = located(path)
        exists = path.exists()
    if not exists:
        words = ("import", "e2e_paper", "THRUST", "MOMENT", "--thrust-sign", 1, "--output", path)
        raise InputError(
            f"{path}: no such file, expected a residual: {quadjax_command(*words)} writes one of "
            "two networks, quadjax fit one of logs"
        )
    arrays, meta = read_npz(path, FORMATS)
    return from_arrays(path, arrays, meta if meta["format"] == FORMAT else meta.get("residual"))


def check_shape(path: Path | str, name: str, layers: Sequence[tuple[Any, Any]]) -> None:
    """Raise an ``InputError`` unless layers have the inputs and outputs of the named network."""
    expected, sizes = SHAPES[name], (layers[0][0].shape[0], layers[-1][0].shape[1])
    if sizes != expected:
        raise InputError(
            f"{path}: the {name} network maps {sizes[0]} inputs to {sizes[1]} outputs, "
            f"expected {expected[0]} to {expected[1]}"
        )


def from_arrays(path: Path | str, arrays: dict[str, np.ndarray], meta: object) -> Residual:
    """The residual of a file's arrays and of its ``meta``.

    Raises:
        InputError: no residual, or a damaged or inconsistent one.
    """
    if not isinstance(meta, dict):
        raise InputError(f"{path}: a policy file without a residual")
    networks: dict[str, Params] = {}
    for name in SHAPES:
        layers = read_layers(path, arrays, f"{name}_")
        check_shape(path, name, layers)
        networks[name] = mlp.to_params(jax.tree.map(np.float32, layers))
    rpm_min, rpm_max = (finite_number(path, meta, key, "meta ") for key in ("rpm_min", "rpm_max"))
    if not rpm_min < rpm_max:
        raise InputError(f"{path}: meta 'rpm_min' {rpm_min} is not below 'rpm_max' {rpm_max}")
    sign = meta.get("thrust_sign")
    if isinstance(sign, bool) or sign not in (1, -1):
        raise InputError(f"{path}: meta 'thrust_sign' is {sign!r}, allowed: [1, -1]")
    numbers = map(jnp.float32, (rpm_min, rpm_max, sign))
    return Residual(networks["thrust"], networks["moment"], *numbers)


def finite_number(
    path: Path | str, values: Mapping[str, object], key: str, prefix: str = ""
) -> float:
    """The finite number at a key of a file, whose name has a ``prefix`` in errors."""
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"{path}: {prefix}{key} is {value!r}, expected a finite number")
    return float(value)
