"""Convert networks of other projects to a policy file or a residual file.

One network is a policy: a model of Stable-Baselines3 (.zip; PPO or A2C with MlpPolicy), a PyTorch
state dict (.pt, .pth) or C source (.c, .h: weights_fc1, biases_fc1, ..). CONFIG is the race that it
was trained in, which defines its observation and its commands. Two networks (.pt, .c) are thrust
and moment of a residual; CONFIG has the range of the propeller speeds. Three are policy, thrust and
moment: a policy file with the residual. One more C file can have the policy's output_std. Nothing
in the files is executed.
"""

import argparse
import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

from quadjax.cli.arguments import Parser, check_outputs, is_override, parse, positive
from quadjax.core.c_arrays import is_c, read_c_std
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading

if TYPE_CHECKING:
    import numpy as np

    from quadjax.config.schema import Config
    from quadjax.policy.file import Policy
    from quadjax.vehicle.residual import Residual


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        "import",
        description=__doc__,
        epilog="Example, a network of INDIflight:\n  quadjax import e2e_shac neural_network.c "
        "track=figure8_tudelft vehicle=5inch\n    --activation relu --motors 4 2 1 3 "
        "--actuator-range 0 3000 --output policy.npz",
    )
    parser.add_argument("config", metavar="CONFIG", help="a preset's name or a YAML file")
    parser.add_argument(
        "files",
        nargs="+",
        metavar="FILE",
        help="policy, or thrust and moment, or all three, and the file with output_std; then "
        "key=value, to change keys of the config",
    )
    parser.add_argument("--output", required=True, metavar="FILE.npz", help="the file to write")
    parser.add_argument("--activation", help="relu or tanh, where a policy's file has none")
    parser.add_argument("--std", type=positive, help="of the noise, where a policy's file has none")
    parser.add_argument(
        "--motors",
        nargs=4,
        type=int,
        metavar="N",
        help="numbers in the network of the motors front-left, front-right, rear-right, rear-left",
    )
    parser.add_argument(
        "--actuator-range",
        nargs=2,
        type=float,
        metavar=("LOW", "HIGH"),
        help="actuator states observed as -1 and 1, if not those of CONFIG",
    )
    parser.add_argument(
        "--thrust-sign",
        type=int,
        choices=(1, -1),
        help="1: the thrust network is added to the force along body z; -1: subtracted (the paper)",
    )
    arguments = parse(parser, argv)
    texts = arguments.files
    arguments.overrides = [text for text in texts if is_override(text)]
    arguments.files = [text for text in texts if not is_override(text)]
    check_outputs(arguments, output=(".npz",))
    return arguments


def main(arguments: Sequence[str] | None = None) -> None:
    """Import a policy or a residual."""
    options = _arguments(arguments)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.vehicle.residual_file import write_residual

    config = load_config(options.config, options.overrides)
    networks, std = _networks(options)
    if len(networks) == 2:
        _refuse(options, ("activation", "std", "motors", "actuator_range"), "a residual")
        residual = _residual(config, networks, options.thrust_sign)
        write_residual(options.output, residual, {"imported": networks})
    else:
        residual = None
        if len(networks) == 1:
            _refuse(options, ("thrust_sign",), "a policy")
        else:
            residual = _residual(config, networks[1:], options.thrust_sign)
        _policy(config, networks[0], std, residual, options).save(options.output)
    print(f"wrote {options.output}")


def _networks(options: argparse.Namespace) -> tuple[list[str], "np.ndarray | None"]:
    """The files of networks, and the standard deviations in the file that has only these."""
    stds = {name: read_c_std(name) for name in options.files if is_c(name)}
    of_std = [name for name, std in stds.items() if std is not None]
    networks = [name for name in options.files if name not in of_std]
    if len(of_std) > 1 or (of_std and len(networks) == 2) or not 1 <= len(networks) <= 3:
        raise InputError(
            f"{len(networks)} networks and {len(of_std)} files with output_std, allowed: a policy "
            "(and output_std), thrust and moment, or policy, thrust and moment (and output_std)"
        )
    if of_std and options.std is not None:
        raise InputError(f"--std has no effect, {of_std[0]} has output_std")
    return networks, stds[of_std[0]] if of_std else options.std


def _refuse(options: argparse.Namespace, names: Sequence[str], kind: str) -> None:
    """Refuse options that have no effect."""
    for name in names:
        if getattr(options, name) is not None:
            raise InputError(f"--{name.replace('_', '-')} has no effect on {kind}")


def _policy(
    config: "Config",
    network: str,
    std: "float | np.ndarray | None",
    residual: "Residual | None",
    options: argparse.Namespace,
) -> "Policy":
    from quadjax.policy.foreign import policy_of

    if residual is not None:  # in place of the config's
        vehicle = config.vehicle.replace(residual=None, residual_gain=1.0)
        config = config.replace(vehicle=vehicle)
    span = options.actuator_range
    policy = policy_of(
        network,
        config,
        options.activation,
        std,
        options.motors,
        None if span is None else (span[0], span[1]),
    )
    sizes = [policy.layers[0][0].shape[0], *(len(bias) for _, bias in policy.layers)]
    print(f"policy of {config.name}: {'-'.join(map(str, sizes))}, {policy.activation}")
    return dataclasses.replace(policy, residual=residual)


def _residual(config: "Config", networks: Sequence[str], sign: int | None) -> "Residual":
    from quadjax.vehicle.residual_file import import_residual

    if sign is None:
        raise InputError("--thrust-sign is missing, allowed: 1 (added) or -1 (subtracted)")
    constants = config.vehicle.constants
    if "rpm_min" not in constants:
        raise InputError(f"{config.name}: vehicle.model is {config.vehicle.model}, expected motor")
    span = (constants["rpm_min"], constants["rpm_max"])
    print(f"residual over {span[0]:g} to {span[1]:g} rpm, thrust sign {sign:+d}")
    return import_residual(networks[0], networks[1], span, sign)
