"""Policies and residuals from networks of other projects, for a race that the caller names."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadjax.config.assembly import make_race
from quadjax.config.checks import check
from quadjax.config.loading import load_config
from quadjax.config.schema import Config, Vehicle
from quadjax.core.errors import InputError
from quadjax.core.files import check_finite
from quadjax.core.mlp import ACTIVATIONS
from quadjax.policy.file import Layers, Policy
from quadjax.policy.network_files import C, Network, read_c, read_network
from quadjax.policy.pilot import command_ranges
from quadjax.race.layout import Layout
from quadjax.vehicle.protocol import VehicleModel
from quadjax.vehicle.residual import Residual, check_shape, from_arrays


def sort_files(
    files: Sequence[str], std: float | None
) -> tuple[list[str], np.ndarray | float | None]:
    """Sort files into networks and standard deviations.

    The standard deviations are ``std`` unless a file contains only ``output_std``.

    Raises:
        InputError: another number of files, or standard deviations twice.
    """
    of_c = {name: read_c(name) for name in files if Path(name).suffix.lower() in C}
    deviations = {name: x.log_std for name, x in of_c.items() if not x.layers}
    networks = [name for name in files if name not in deviations]
    count = len(deviations)
    if count > 1 or (count and len(networks) == 2) or not 1 <= len(networks) <= 3:
        raise InputError(
            f"{len(networks)} networks and {count} files with output_std, allowed: a policy "
            "(and output_std), thrust and moment, or policy, thrust and moment (and output_std)"
        )
    for name, values in deviations.items():
        if std is not None:
            raise InputError(f"--std has no effect, {name} has output_std")
        return networks, None if values is None else np.exp(values)
    return networks, std


def import_policy(
    path: Path | str,
    config: Config | Path | str,
    activation: str | None = None,
    std: float | np.ndarray | None = None,
    motors: Sequence[int] | None = None,
    actuator_range: tuple[float, float] | None = None,
) -> Policy:
    """The policy of a file, for the race that it was trained in.

    Args:
        path: of the file; see ``read_network``.
        config: of the race, whose observation and commands are those of the network.
        activation: of the hidden layers, "relu" or "tanh", where the file has none.
        std: standard deviation of the noise, one or (actions,), where the file has none.
        motors: the network's numbers (1 to 4) of the motors front-left, front-right, rear-right,
            rear-left; None: in this order.
        actuator_range: ``observation.actuator_range`` of the race; None: that of the config.

    Raises:
        InputError: a file that cannot be read, or a network that does not fit the race.
    """
    config = config if isinstance(config, Config) else load_config(config)
    if actuator_range is not None:
        config = config.at("observation.actuator_range", actuator_range)
        check(config)
    environment, params = make_race(config)
    network, model = read_network(path), environment.model
    layout = environment.layout.with_spans(model, params)
    _check_sizes(path, network.layers, layout, model, config.name)
    activation = _activation(path, network, activation)
    low, high = command_ranges(environment, params)
    log_std = _log_std(path, network, len(low), std)
    if motors is not None:
        order = _order(path, model, motors)
        network, log_std = _reordered(network, layout, order), log_std[order]
    return Policy(
        layers=network.layers,
        log_std=log_std,
        vehicle=model.name,
        activation=activation,
        command_low=low,
        command_high=high,
        layout=layout,
        source={"imported": Path(path).name},
        value=network.value,
        config=config.model_dump(mode="json", by_alias=True),
    )


def _activation(path: Path | str, network: Network, activation: str | None) -> str:
    """The activation of a network's hidden layers: that in its file, or else the argument."""
    if network.activation and activation and network.activation != activation:
        raise InputError(f"{path}: its activation is {network.activation}, not {activation}")
    activation = network.activation or activation
    if activation not in ACTIVATIONS:
        state = f"is {activation}" if activation else "is not in the file, give it (--activation)"
        raise InputError(f"{path}: the activation {state}, allowed: {', '.join(ACTIVATIONS)}")
    return activation


def _order(path: Path | str, model: VehicleModel, motors: Sequence[int]) -> np.ndarray:
    """The network's indices of the motors in this project's order."""
    count = model.action_size
    if not model.by_rotor or sorted(motors) != list(range(1, count + 1)):
        raise InputError(
            f"{path}: motors {list(motors)}, expected each of 1 to {count} once, and a vehicle "
            "model that commands each motor"
        )
    return np.array(motors) - 1


def _reordered(network: Network, layout: Layout, order: np.ndarray) -> Network:
    """A network with each number of a motor, observed or commanded, in this project's order."""
    rows = np.arange(layout.size)
    for seen in (layout.slice(field.name) for field in layout.fields if field.by_rotor):
        rows[seen] = rows[seen][order]

    def reordered(layers: Layers) -> Layers:
        (kernel, bias), *rest = layers
        return ((kernel[rows], bias), *rest)

    *rest, (kernel, bias) = reordered(network.layers)
    layers = (*rest, (kernel[:, order], bias[order]))
    value = None if network.value is None else reordered(network.value)
    return dataclasses.replace(network, layers=layers, value=value)


def _log_std(
    path: Path | str, network: Network, actions: int, std: float | np.ndarray | None
) -> np.ndarray:
    log_std = network.log_std
    if log_std is not None and std is not None:
        raise InputError(f"{path}: has a standard deviation, so std {std} has no effect")
    if std is not None:
        log_std = np.log(std if np.ndim(std) else np.full(actions, std))
    if log_std is None:
        hint = "give the noise's std (--std) or the file that has it"
        raise InputError(f"{path}: no log_std or output_std, {hint}")
    if log_std.shape != (actions,):
        raise InputError(f"{path}: {log_std.size} standard deviations, expected {actions}")
    check_finite(path, "log_std", log_std)
    return log_std.astype(np.float32)


def _check_sizes(
    path: Path | str, layers: Layers, layout: Layout, model: VehicleModel, race: str
) -> None:
    """Check that a network observes and commands what policies of the race do."""
    inputs, outputs = layers[0][0].shape[0], layers[-1][0].shape[1]
    if inputs != layout.size:
        fields = ", ".join(f"{field.name} {field.size}" for field in layout.fields)
        stack, rest = divmod(inputs, layout.size)
        stacked = "" if rest else f"; {stack} stacked observations are not supported"
        raise InputError(
            f"{path}: the network takes {inputs} numbers, policies of {race} observe {layout.size}:"
            f" {fields}{stacked}"
        )
    if outputs != model.action_size:
        raise InputError(
            f"{path}: the network gives {outputs} numbers, the vehicle model {model.name} takes "
            f"{model.action_size}"
        )


def import_residual(
    vehicle: Vehicle,
    networks: Sequence[Path | str],
    sign: int | None,
    rpm_range: tuple[float, float] | None = None,
) -> Residual:
    """A residual from two networks with ReLU: PyTorch state dicts of linear layers, or C source.

    Args:
        vehicle: its propeller speeds ``rpm_min`` and ``rpm_max`` enter as -1 and 1.
        networks: of the thrust, 7 inputs and 1 output, and of the moment, 10 inputs and 3
            outputs; see ``quadjax.vehicle.residual``.
        sign: +1 if the first network's output is added to the body-z specific force, -1 if it is
            subtracted, as printed in the paper.
        rpm_range: propeller speeds that enter as -1 and 1, if not those of the vehicle.

    Raises:
        InputError: a file that cannot be read, networks of other sizes, a vehicle without
            propeller speeds, or no sign; in one line.
    """
    if sign is None:
        raise InputError("--thrust-sign is missing, allowed: 1 (added) or -1 (subtracted)")
    if "rpm_min" not in vehicle.constants:
        raise InputError(f"vehicle.model is {vehicle.model}, expected motor")
    low, high = rpm_range or (vehicle.constants[key] for key in ("rpm_min", "rpm_max"))
    meta = {"rpm_min": low, "rpm_max": high, "thrust_sign": sign}
    arrays: dict[str, np.ndarray] = {}
    for name, path in zip(("thrust", "moment"), networks, strict=True):
        network = read_network(path)
        if network.activation not in ("relu", None):
            raise InputError(f"{path}: its activation is {network.activation}, a residual has relu")
        check_shape(path, name, network.layers)
        for index, (kernel, bias) in enumerate(network.layers):
            arrays |= {f"{name}_kernel_{index}": kernel, f"{name}_bias_{index}": bias}
    return from_arrays(networks[0], arrays, meta)
