"""``quadjax import``."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import wrote
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading
from quadjax.policy.c_arrays import is_c, read_c_std

if TYPE_CHECKING:
    import numpy as np

    from quadjax.config.schema import Config as TrainingConfig
    from quadjax.vehicle.residual import Residual

Motors = Annotated[
    tuple[int, int, int, int],
    Parameter(converter=opt.several(opt.whole(1, 4)).converter, metavar="N N N N"),
]
Span = Annotated[
    tuple[float, float],
    Parameter(converter=opt.several(opt.number(-1e6, 1e6)).converter, metavar="LOW HIGH"),
]


def import_(
    config: opt.Config,
    /,
    *files: Annotated[str, Parameter(name="FILE|KEY=VALUE", required=True)],
    output: Annotated[Path, opt.Output((".npz",)), Parameter(metavar="FILE.npz")],
    activation: Literal["relu", "tanh"] | None = None,
    std: opt.Positive | None = None,
    motors: Motors | None = None,
    actuator_range: Span | None = None,
    thrust_sign: Literal["1", "-1"] | None = None,
) -> None:
    """Convert networks of other projects to a policy file or a residual file.

    One network is a policy: a model of Stable-Baselines3 (.zip; PPO or A2C with
    MlpPolicy), a PyTorch state dict (.pt, .pth) or C source (.c, .h: weights_fc1,
    biases_fc1, ..). CONFIG is the race that it was trained in, which defines its
    observation and its commands. Two networks (.pt, .c) are thrust and moment of a
    residual; CONFIG has the range of the propeller speeds. Three are policy, thrust
    and moment: a policy file with the residual. One more C file can have the
    policy's output_std. Nothing in the files is executed.

    Example, a network of INDIflight:
    quadjax import e2e neural_network.c track=figure8_tudelft vehicle=5inch
    --activation relu --motors 4 2 1 3 --actuator-range 0 3000 --output policy.npz

    Args:
        files: Policy, or thrust and moment, or all three, and the file with output_std;
            and changes of keys of the config.
        output: The file to write.
        activation: Of a policy whose file has none.
        std: Of the noise, where a policy's file has none.
        motors: Numbers in the network of the motors front-left, front-right, rear-right,
            rear-left.
        actuator_range: Actuator states observed as -1 and 1, if not those of CONFIG.
        thrust_sign: 1: the thrust network is added to the force along body z; -1:
            subtracted (the paper).
    """
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.policy.foreign import policy_of
        from quadjax.vehicle.residual import write_residual

    race = load_config(config, [text for text in files if opt.is_override(text)])
    networks, deviations = _networks([text for text in files if not opt.is_override(text)], std)
    if len(networks) == 2:
        options = {"activation": activation, "std": std, "motors": motors}
        _refuse({**options, "actuator-range": actuator_range}, "a residual")
        write_residual(output, _residual(race, networks, thrust_sign), {"imported": networks})
    else:
        residual = None
        if len(networks) == 1:
            _refuse({"thrust-sign": thrust_sign}, "a policy")
        else:
            residual = _residual(race, networks[1:], thrust_sign)
            vehicle = race.vehicle.replace(residual=None, residual_gain=1.0)  # the files' instead
            race = race.replace(vehicle=vehicle)
        policy = policy_of(networks[0], race, activation, deviations, motors, actuator_range)
        sizes = [policy.layers[0][0].shape[0], *(len(bias) for _, bias in policy.layers)]
        print(f"policy of {race.name}: {'-'.join(map(str, sizes))}, {policy.activation}")
        dataclasses.replace(policy, residual=residual).save(output)
    wrote(output)


def _networks(
    files: Sequence[str], std: float | None
) -> tuple[list[str], "np.ndarray | float | None"]:
    """The files of networks, and the standard deviations in the file that has only these."""
    stds = {name: read_c_std(name) for name in files if is_c(name)}
    of_std = [name for name, values in stds.items() if values is not None]
    networks = [name for name in files if name not in of_std]
    if len(of_std) > 1 or (of_std and len(networks) == 2) or not 1 <= len(networks) <= 3:
        raise InputError(
            f"{len(networks)} networks and {len(of_std)} files with output_std, allowed: a policy "
            "(and output_std), thrust and moment, or policy, thrust and moment (and output_std)"
        )
    if of_std and std is not None:
        raise InputError(f"--std has no effect, {of_std[0]} has output_std")
    return networks, stds[of_std[0]] if of_std else std


def _refuse(options: Mapping[str, object], kind: str) -> None:
    """Refuse options that have no effect."""
    for name, value in options.items():
        if value is not None:
            raise InputError(f"--{name} has no effect on {kind}")


def _residual(config: "TrainingConfig", networks: Sequence[str], sign: str | None) -> "Residual":
    from quadjax.policy.foreign_residual import import_residual

    if sign is None:
        raise InputError("--thrust-sign is missing, allowed: 1 (added) or -1 (subtracted)")
    constants = config.vehicle.constants
    if "rpm_min" not in constants:
        raise InputError(f"{config.name}: vehicle.model is {config.vehicle.model}, expected motor")
    span = (constants["rpm_min"], constants["rpm_max"])
    print(f"residual over {span[0]:g} to {span[1]:g} rpm, thrust sign {int(sign):+d}")
    return import_residual(networks[0], networks[1], span, int(sign))
