"""Time constants of the inner loop: step responses on the plant, fitted by first-order lags."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize_scalar

from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import gusts, indi, plant
from quadjax.plant.build import build_plant, nominal_vehicle
from quadjax.plant.config import PlantConfig
from quadjax.plant.indi import IndiParams
from quadjax.plant.plant import PlantParams
from quadjax.vehicle.motor import hover_rpm
from quadjax.vehicle.protocol import Measurement
from quadjax.vehicle.rate import RateCommand
from quadjax.vehicle.rigid_body import RigidBodyState

SECONDS = 0.2
EXPECTED = (0.025, 0.035)  # s, around the 0.03 s of the training model
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
        error: root mean square of the fit's error, as a fraction of the step.
        saturated: time with a motor command at a limit, s.
        time: (n,) s since the step.
        response: (n,) rad/s, or m/s^2.
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
        """First value of the response."""
        return float(self.response[0])


def identify(config: PlantConfig, steps: dict[str, tuple[float, ...]] = STEPS) -> list[Step]:
    """Simulate steps from hover with exact measurements, and fit each.

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
    responses = np.asarray(
        _fly(count, params, loop, jnp.asarray(commands, jnp.float32)), np.float64
    )
    time = np.arange(count) / config.sample_rate
    return [
        fit_step(axis, value, time, responses[:, AXES.index(axis), row], responses[:, 4, row])
        for row, (axis, value) in enumerate(asked)
    ]


def fit_step(
    axis: str,
    target: float,
    time: np.ndarray,
    response: np.ndarray,
    saturated: np.ndarray | None = None,
) -> Step:
    """Least-squares fit of ``start + (target - start) (1 - exp(-t / tau))`` to a response.

    Args:
        axis: one of ``AXES``.
        target: of the step.
        time: (n,) s from the instant of the step.
        response: (n,).
        saturated: (n,) whether a motor command was at a limit.
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
    """Responses (count, 5, steps) to steps from hover to commands (steps, 4).

    Rates, specific thrust, and 1 where a motor command is at a limit.
    """
    c = params.vehicle.constants

    def one(command: jax.Array) -> jax.Array:
        wanted = RateCommand(Vec3.of(command[:3]), command[3])
        up = Vec3(jnp.zeros(()), jnp.zeros(()), jnp.full((), -100.0))  # far from the ground
        rpm = Rotors.same(hover_rpm(c))
        zero = Vec3.zero()
        body = RigidBodyState(up, zero, zero, zero, rpm, zero, zero)
        none = jnp.zeros(gusts.START_DRAWS)
        state = plant.begin(params, body, jnp.ones(()), none)
        inner = indi.init(loop, _measure(params, state))

        def sample(carry: tuple, _: None) -> tuple[tuple, jax.Array]:
            state, inner = carry
            now = _measure(params, state)
            inner, command = indi.update(loop, inner, now, wanted)
            following = plant.update(params, state, command, none[: gusts.DRAWS])
            limits = [(u <= c.rpm_min) | (u >= c.rpm_max) for u in command.components()]
            limited = (limits[0] | limits[1] | limits[2] | limits[3]).astype(jnp.float32)
            shown = jnp.stack([*now.gyro.components(), -now.specific_force.z, limited])
            return (following, inner), shown

        return jax.lax.scan(sample, (state, inner), None, count)[1]

    return jax.vmap(one, out_axes=-1)(commands)


def _measure(params: PlantParams, state: plant.PlantState) -> Measurement:
    """An exact measurement, without the velocity, which the inner loop does not use."""
    truth = plant.truth_of(params, state)
    return Measurement(truth.rates, truth.specific_force, truth.rpm, Vec3.zero())


def table(steps: list[Step]) -> str:
    """The steps as text, with whether each has the training model's time constant."""
    low, high = EXPECTED
    lines = ["axis   from     to     tau  error  motors at a limit  0.025-0.035 s"]
    for step in steps:
        fine = "yes" if low <= step.tau <= high else "no"
        lines.append(
            f"{step.axis:>4} {step.start:6.2f} {step.target:6.2f} {1e3 * step.tau:5.1f}ms "
            f"{100.0 * step.error:5.1f}% {1e3 * step.saturated:15.0f} ms  {fine}"
        )
    return "\n".join(lines)
