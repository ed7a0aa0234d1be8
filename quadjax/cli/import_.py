"""``quadjax import``."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from quadjax.cli import options as opt
from quadjax.cli.files import is_override
from quadjax.cli.output import note, wrote
from quadjax.core.interruptions import loading

Motor = Annotated[int, opt.whole(1, 4)]
End = Annotated[float, opt.number(-1e6, 1e6)]
Motors = Annotated[tuple[Motor, Motor, Motor, Motor], Parameter(metavar="N N N N")]
Span = Annotated[tuple[End, End], Parameter(metavar="LOW HIGH")]


def import_(
    config: opt.ConfigName,
    /,
    *files: Annotated[str, Parameter(name="FILE|KEY=VALUE", required=True)],
    output: Annotated[Path, opt.Output((".npz",)), Parameter(metavar="FILE.npz")],
    activation: Literal["relu", "tanh"] | None = None,
    std: opt.Positive | None = None,
    motors: Motors | None = None,
    actuator_range: Span | None = None,
    thrust_sign: Literal["1", "-1"] | None = None,
    residual_range: Span | None = None,
) -> None:
    """Convert networks of other projects to a policy file or a residual file.

    One network is a policy: a model of Stable-Baselines3 (.zip; PPO or A2C with
    MlpPolicy), a PyTorch state dict (.pt, .pth, .ckpt) or C source (.c, .h: weights_fc1,
    biases_fc1, ..). CONFIG is the race that it was trained in, which defines its
    observation and its commands. Two networks (.pt, .c) are thrust and moment of a
    residual; CONFIG has the range of the propeller speeds. Three are policy, thrust
    and moment: a policy file with the residual. One more C file can have the
    policy's output_std. Nothing in the files is executed. A .zip needs the extra
    sb3, a .pt the extra torch.

    Example, a network of INDIflight:
    quadjax import e2e neural_network.c track=figure8_tudelft vehicle=5inch
    --activation relu --motors 4 2 1 3 --actuator-range 0 3000 --output policy.npz

    Args:
        files: Policy, or thrust and moment, or all three, and the file with output_std;
            and changes of keys of the config.
        output: The file to write.
        activation: Activation of a policy whose file has none.
        std: Standard deviation of the noise, where a policy's file has none.
        motors: Numbers in the network of the motors front-left, front-right, rear-right,
            rear-left.
        actuator_range: Actuator states observed as -1 and 1, if not those of CONFIG:
            observation.actuator_range.
        residual_range: Propeller speeds, rpm, that enter a residual as -1 and 1, if not
            those of CONFIG.
        thrust_sign: 1: the thrust network is added to the force along body z; -1:
            subtracted (the paper).
    """
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.policy.foreign import import_policy, import_residual, sort_files
        from quadjax.policy.network_files import ASSUMED
        from quadjax.vehicle.residual import write_residual

    race = load_config(config, [text for text in files if is_override(text)])
    networks, deviations = sort_files([text for text in files if not is_override(text)], std)
    sign = None if thrust_sign is None else int(thrust_sign)
    if len(networks) == 2:
        of_policy = {"activation": activation, "std": std, "motors": motors}
        opt.refuse("on a residual", **of_policy, actuator_range=actuator_range)
        write_residual(
            output,
            import_residual(race.vehicle, networks, sign, residual_range),
            {"imported": networks},
        )
        wrote(output)
        return
    residual = None
    if len(networks) == 1:
        opt.refuse("on a policy", thrust_sign=thrust_sign, residual_range=residual_range)
    else:
        opt.refuse("on a residual, import it alone", motors=motors)
        residual = import_residual(race.vehicle, networks[1:], sign, residual_range)
        vehicle = race.vehicle.replace(residual=None, residual_gain=1.0)  # the files' instead
        race = race.replace(vehicle=vehicle)
    policy = import_policy(networks[0], race, activation, deviations, motors, actuator_range)
    print(f"policy of {race.name}: {policy.describe()}")
    note(ASSUMED)
    dataclasses.replace(policy, residual=residual).save(output)
    wrote(output)
