"""Convert a network of another project to a policy file, or two networks to a residual file.

One file is a policy: a model of Stable-Baselines3 (.zip; PPO or A2C with MlpPolicy), a PyTorch
state dict (.pt, .pth) or C arrays (.c, .h: weights_fc1, biases_fc1, .., output_std). CONFIG is the
race that it was trained in, which defines its observation and its commands. Two files are the
thrust and the moment network of a residual (.pt, .pth); CONFIG has the range of the propeller
speeds. Nothing in the files is executed.
"""

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from quadjax.cli.arguments import Parser, check_outputs, is_override, parse, positive
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading

if TYPE_CHECKING:
    from quadjax.config.schema import Config


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
        help="one file, or thrust and moment; then key=value, to change keys of the config",
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
    given = arguments.files
    arguments.overrides = [text for text in given if is_override(text)]
    arguments.files = [text for text in given if not is_override(text)]
    check_outputs(arguments, output=(".npz",))
    return arguments


def main(arguments: Sequence[str] | None = None) -> None:
    """Import a policy or a residual."""
    options = _arguments(arguments)
    with loading():
        from quadjax.config.loading import load_config

    config = load_config(options.config, options.overrides)
    if len(options.files) == 1:
        _import_policy(config, options)
    elif len(options.files) == 2:
        _import_residual(config, options)
    else:
        raise InputError(f"{len(options.files)} files, allowed: a policy, or thrust and moment")
    print(f"wrote {options.output}")


def _refuse(options: argparse.Namespace, names: Sequence[str], kind: str) -> None:
    """Refuse options that have no effect."""
    for name in names:
        if getattr(options, name) is not None:
            raise InputError(f"--{name.replace('_', '-')} has no effect on {kind}")


def _import_policy(config: "Config", options: argparse.Namespace) -> None:
    from quadjax.policy.foreign import policy_of

    _refuse(options, ("thrust_sign",), "a policy")
    span = options.actuator_range
    policy = policy_of(
        options.files[0],
        config,
        options.activation,
        options.std,
        options.motors,
        None if span is None else (span[0], span[1]),
    )
    policy.save(options.output)
    sizes = [policy.layers[0][0].shape[0], *(len(bias) for _, bias in policy.layers)]
    print(f"policy of {config.name}: {'-'.join(map(str, sizes))}, {policy.activation}")


def _import_residual(config: "Config", options: argparse.Namespace) -> None:
    from quadjax.vehicle.residual_file import import_residual, write_residual

    _refuse(options, ("activation", "std", "motors", "actuator_range"), "a residual")
    if options.thrust_sign is None:
        raise InputError("--thrust-sign is missing, allowed: 1 (added) or -1 (subtracted)")
    constants = config.vehicle.constants
    if "rpm_min" not in constants:
        raise InputError(f"{config.name}: vehicle.model is {config.vehicle.model}, expected motor")
    thrust, moment = options.files
    span = (constants["rpm_min"], constants["rpm_max"])
    residual = import_residual(thrust, moment, span, options.thrust_sign)
    write_residual(options.output, residual, {"imported": [str(thrust), str(moment)]})
    print(f"residual over {span[0]:g} to {span[1]:g} rpm, thrust sign {options.thrust_sign:+d}")
