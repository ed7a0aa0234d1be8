"""How fast the inner loop is: step responses on the plant, fitted to the first-order model.

As a command, on the plant with every effect off, or on the stand-in plant with ``--effects``::

    python -m quadjax.studies.identify configs/plant/standin.yaml
"""

import argparse
import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize_scalar

from quadjax.cli.arguments import Parser, parse
from quadjax.core.errors import command_line
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import gusts, indi, plant
from quadjax.plant.build import build_plant, nominal_vehicle
from quadjax.plant.indi import Felt, IndiParams
from quadjax.plant.plant import PlantParams
from quadjax.plant.plant_schema import (
    NO_EFFECTS,
    DelayConfig,
    PlantConfig,
    load_plant_config,
)
from quadjax.vehicle.motor import MotorState, hover_rpm
from quadjax.vehicle.rate import RateCommand

SECONDS = 0.2
BELIEVED = (0.025, 0.035)  # s, about the 0.03 s of the training model
AXES = ("p", "q", "r", "T")
# Steps inside the paper's limits, rates in rad/s and thrust in m/s^2, from hover.
STEPS: dict[str, tuple[float, ...]] = {
    "p": (0.5, 1.0, -1.0, 2.0, 3.0, -3.0),
    "q": (0.5, 1.0, -1.0, 2.0, 3.0, -3.0),
    "r": (0.5, 1.0, -1.0, 2.0, 3.0, -3.0),
    "T": (8.0, 11.0, 12.5, 5.0, 15.0, 2.0),
}


@dataclasses.dataclass(frozen=True)
class Step:
    """One step response.

    Attributes:
        axis: one of ``AXES``.
        target: rad/s, or m/s^2.
        tau: fitted time constant, s.
        error: root mean square of what the fit leaves, as a share of the step.
        saturated: s for which a motor was told its highest or lowest speed.
        time: (n,) s since the step.
        response: (n,) what was flown.
    """

    axis: str
    target: float
    tau: float
    error: float
    saturated: float
    time: np.ndarray
    response: np.ndarray

    @property
    def start(self) -> float:
        """Where the response started."""
        return float(self.response[0])


def without_effects(config: PlantConfig) -> PlantConfig:
    """The same drone with every effect off and no delay: the training model."""
    return dataclasses.replace(config, effects=NO_EFFECTS, delay=DelayConfig(0.0, 0.0))


def identify(config: PlantConfig, steps: dict[str, tuple[float, ...]] = STEPS) -> list[Step]:
    """Fly steps from hover with exact measurements, and fit each.

    Args:
        config: of the plant and its inner loop.
        steps: targets of each axis, rad/s or m/s^2.
    """
    params = build_plant(config)
    loop = indi.indi_params(nominal_vehicle(config).motor, config.indi, config.sample_rate)
    asked = [(axis, value) for axis in AXES for value in steps.get(axis, ())]
    hover = float(params.vehicle.constants.g)
    commands = np.tile([0.0, 0.0, 0.0, hover], (len(asked), 1))
    for row, (axis, value) in enumerate(asked):
        commands[row, AXES.index(axis)] = value
    count = round(SECONDS * config.sample_rate)
    flown = np.asarray(_fly(count, params, loop, jnp.asarray(commands, jnp.float32)), np.float64)
    time = np.arange(count) / config.sample_rate
    return [
        fit_step(axis, value, time, flown[:, AXES.index(axis), row], flown[:, 4, row])
        for row, (axis, value) in enumerate(asked)
    ]


def fit_step(
    axis: str,
    target: float,
    time: np.ndarray,
    response: np.ndarray,
    saturated: np.ndarray | None = None,
) -> Step:
    """The first-order lag ``start + (target - start) (1 - exp(-t / tau))`` nearest to a response.

    Least squares over the whole response; times (n,), s, from the instant of the step, and where
    it is known whether (n,) a motor was at its limit.
    """
    start = response[0]

    def left(tau: float) -> float:
        model = target + (start - target) * np.exp(-time / tau)
        return float(np.mean((response - model) ** 2))

    tau = float(minimize_scalar(left, bounds=(1e-3, 1.0), method="bounded").x)
    size = max(abs(target - start), 1e-9)
    held = 0.0 if saturated is None else float(saturated.mean() * (time[-1] + time[1]))
    return Step(axis, target, tau, float(np.sqrt(left(tau))) / size, held, time, response)


@functools.partial(jax.jit, static_argnums=0)
def _fly(count: int, params: PlantParams, loop: IndiParams, commands: jax.Array) -> jax.Array:
    """What steps from hover to commands (steps, 4) lead to, (count, 5, steps).

    Rates, specific thrust, and 1 where a motor is told its highest or lowest speed.
    """
    c = params.vehicle.constants

    def one(command: jax.Array) -> jax.Array:
        wanted = RateCommand(Vec3.of(command[:3]), command[3])
        up = Vec3(jnp.zeros(()), jnp.zeros(()), jnp.full((), -100.0))  # far from the ground
        rpm = Rotors.same(hover_rpm(c))
        zeros = [Vec3.zero() for _ in range(5)]
        body = MotorState(up, *zeros[:3], rpm, *zeros[3:])
        none = jnp.zeros(gusts.START_DRAWS)
        state = plant.begin(params, body, jnp.ones(()), none)
        inner = indi.init(loop, _felt(params, state))

        def sample(carry: tuple, _: None) -> tuple[tuple, jax.Array]:
            state, inner = carry
            felt = _felt(params, state)
            inner, command = indi.update(loop, inner, felt, wanted)
            following = plant.update(params, state, command, none[: gusts.DRAWS])
            limits = [(u <= c.rpm_min) | (u >= c.rpm_max) for u in command.components()]
            limited = (limits[0] | limits[1] | limits[2] | limits[3]).astype(jnp.float32)
            shown = jnp.stack([*felt.gyro.components(), -felt.force_z, limited])
            return (following, inner), shown

        return jax.lax.scan(sample, (state, inner), None, count)[1]

    return jax.vmap(one, out_axes=-1)(commands)


def _felt(params: PlantParams, state: plant.PlantState) -> Felt:
    truth = plant.truth_of(params, state)
    return Felt(truth.rates, truth.specific_force.z, truth.rpm)


def table(steps: list[Step]) -> str:
    """The steps as text, each with whether the training model's time constant holds."""
    low, high = BELIEVED
    lines = ["axis   from     to     tau  left  motors at a limit  0.025-0.035 s"]
    for step in steps:
        fine = "yes" if low <= step.tau <= high else "no"
        lines.append(
            f"{step.axis:>4} {step.start:6.2f} {step.target:6.2f} {1e3 * step.tau:5.1f}ms "
            f"{100.0 * step.error:4.1f}% {1e3 * step.saturated:15.0f} ms  {fine}"
        )
    return "\n".join(lines)


def main() -> None:
    """Identify the inner loop's time constants."""
    parser = Parser(description=main.__doc__, formatter_class=argparse.HelpFormatter)
    parser.add_argument("config", help="YAML file of configs/plant")
    parser.add_argument("words", nargs="*", metavar="key=value", help="changes to the config")
    parser.add_argument("--effects", action="store_true", help="on the stand-in plant as it is")
    arguments = parse(parser)
    config = load_plant_config(arguments.config, arguments.words)
    if not arguments.effects:
        config = without_effects(config)
    print(table(identify(config)))


if __name__ == "__main__":
    command_line(main)()
