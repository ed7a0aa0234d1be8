"""What an inner loop needs of a policy that commands rates and thrust: ``inner_loop.yaml``.

The commands in their order with units, limits and the scale to the autopilot's own integers; how
often they come; the lags that the training assumes of the loop; and the airframe's numbers from
which an INDI loop computes its control effectiveness (Smeur, Chu and de Croon, 2016), as
``quadjax.plant.indi`` does.
"""

from typing import Any

import numpy as np

from quadjax.core.yaml_files import parse_yaml, to_yaml
from quadjax.export.race_source import PolicyRace
from quadjax.export.render import call_frequency
from quadjax.export.targets import Target
from quadjax.export.words import FixedPolicy
from quadjax.race.layout import LAST_ACTION

FILE, FORMAT = "inner_loop.yaml", "quadjax-inner-loop/1"
MODEL = "rate"  # the vehicle model whose commands the file describes
AXES = {
    "p": "body rate about the forward axis, right side down",
    "q": "body rate about the right axis, nose up",
    "r": "body rate about the down axis, clockwise from above",
    "thrust": "specific thrust along body -z, up",
}
EFFECTIVENESS = ("i_xx", "i_yy", "i_zz", "k_p", "k_q", "k_r1", "k_r2", "k_w", "tau")
RANGE = ("rpm_min", "rpm_max")
BFP_RATE, MAX_PPRZ = 4096, 9600  # INT32_RATE_FRAC of 12 bits, and the largest command of Paparazzi
COMMENTS = {
    "commands": """\
In the order of quadjax_module_command or qj_pilot_step. scale: the autopilot's own integer is
command times scale, rounded; none if it takes the command in its unit.""",
    "commands_hz": """\
New commands come at this rate; null: at every call of the pilot. The policy was trained at
training_hz.""",
    "response": """\
First-order time constants, s, of the response of rates and thrust in training.""",
    "airframe": """\
SI, rpm. Rotors 1 front-left, 2 front-right, 3 rear-right, 4 rear-left; angular accelerations
k_p/i_xx (w1^2 - w2^2 - w3^2 + w4^2), k_q/i_yy (w1^2 + w2^2 - w3^2 - w4^2) and
(k_r1 s + k_r2 s')/i_zz with s = -w1 + w2 - w3 + w4; specific thrust k_w (w1^2 + .. + w4^2);
motors tau w' = command - w.""",
    "throttle": """\
Steady rpm of each rotor, and Paparazzi's thrust command if the servos of the airframe go from
rpm_min to rpm_max: at hover and at the lowest and the highest command.""",
}


def inner_loop(policy: FixedPolicy, race: PolicyRace, target: Target) -> str | None:
    """The text of the file; None for a policy that commands no inner loop.

    Args:
        policy: the fixed-point policy.
        race: its race, whose vehicle file has the airframe if it has the model ``motor``.
        target: for which the policy is exported.
    """
    network = policy.network
    if network.model.name != MODEL:
        return None
    unit, paparazzi = 2.0**network.fraction_bits, target.glue == "paparazzi"
    low, high = ((ends / unit).tolist() for ends in (network.command_low, network.command_high))
    constants = race.params.vehicle.constants
    commands = []
    for (name, axis), ends in zip(AXES.items(), zip(low, high, strict=True), strict=True):
        is_rate = name != "thrust"
        command: dict[str, object] = {"name": name, "is": axis}
        command |= {"unit": "rad/s" if is_rate else "m/s^2", "low": ends[0], "high": ends[1]}
        if paparazzi and is_rate:
            command |= {"scale": BFP_RATE, "integer": "int32_t, INT32_RATE_FRAC"}
        commands.append(command)
    held = LAST_ACTION in race.environment.layout
    training, calls = 1.0 / race.time_step, call_frequency(policy) if target.calls else None
    tree: dict[str, object] = {
        "format": FORMAT,
        "policy": policy.name,
        "policy_sha256": policy.policy_hash,
        "autopilot": target.autopilot,
        "commands": commands,
        "commands_hz": round(training, 3) if held else calls,
        "training_hz": round(training, 3),
        "response": {"rates": _number(constants.tau_rate), "thrust": _number(constants.tau_thrust)},
    }
    config: Any = parse_yaml(race.text, "the race's config")
    motor: dict[str, float] | None = (config["vehicle"].get("models") or {}).get("motor")
    if motor:
        tree["airframe"] = {name: motor[name] for name in (*EFFECTIVENESS, *RANGE)}
        thrusts = {"hover": _number(constants.g), "low": low[3], "high": high[3]}
        tree["throttle"] = {
            name: _throttle(thrust, motor, paparazzi) for name, thrust in thrusts.items()
        }
    head = (
        f"# What the inner loop needs of {policy.name}, written by quadjax export. World "
        "north-east-down,\n# body forward-right-down. Docs: docs/guide/exporting.md of quadjax.\n"
    )
    return head + to_yaml(tree, COMMENTS)


def _number(value: object) -> float:
    """A 32-bit float with the digits that it has."""
    return float(str(np.float32(np.asarray(value))))


def _throttle(thrust: float, motor: dict[str, float], paparazzi: bool) -> dict[str, float]:
    """The steady state of a specific thrust, m/s^2, with each rotor within its range."""
    lowest, highest = (motor[name] for name in RANGE)
    rpm = min(max((max(thrust, 0.0) / (4.0 * motor["k_w"])) ** 0.5, lowest), highest)
    numbers: dict[str, float] = {"thrust": thrust, "rpm": round(rpm, 1)}
    if paparazzi:
        numbers["pprz"] = round(MAX_PPRZ * (rpm - lowest) / (highest - lowest))
    return numbers
