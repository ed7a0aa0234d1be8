"""Time constants of the inner loop: step responses on the plant, fitted by first-order lags.

From hover, without effects and delays, with the gains of ``exact`` (the defaults) and ``standin``:
``python -m benchmarks.identify`` prints them and writes the rows of ``identify.json``.
"""

import functools
import statistics

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import rows
from benchmarks.first_order import Step, fit_step
from quadjax.cli import script
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import gusts, indi, plant
from quadjax.plant.config import PlantConfig, load_plant_config, without_effects
from quadjax.plant.plant import build_plant, nominal_vehicle
from quadjax.vehicle.motor import hover_rpm
from quadjax.vehicle.protocol import Measurement
from quadjax.vehicle.rate import RateCommand
from quadjax.vehicle.rigid_body import RigidBodyState

SECONDS, EXPECTED = 0.2, (0.025, 0.035)  # s; the training model has 0.03 s
RATES = (0.5, 1.0, -1.0, 2.0, 3.0, -3.0)  # rad/s
STEPS = {"p": RATES, "q": RATES, "r": RATES, "T": (8.0, 11.0, 12.5, 5.0, 15.0, 2.0)}  # T: m/s^2


def responses(config: PlantConfig, steps: dict[str, tuple[float, ...]] = STEPS) -> list[Step]:
    """Simulate steps from hover with exact measurements, and fit each."""
    params, axes = build_plant(config), list(STEPS)
    loop = indi.indi_params(nominal_vehicle(config).motor, config.indi, config.sample_rate)
    asked = [(axis, x) for axis, values in steps.items() for x in values]
    commands = np.tile([0.0, 0.0, 0.0, float(params.vehicle.constants.g)], (len(asked), 1))
    for row, (axis, value) in zip(commands, asked):
        row[axes.index(axis)] = value
    count, rate, found = round(SECONDS * config.sample_rate), config.sample_rate, []
    flown = np.float64(_fly(count, params, loop, np.float32(commands)))
    for (axis, value), response in zip(asked, np.moveaxis(flown, 2, 0)):
        values, limited = response[:, axes.index(axis)], response[:, 4].mean()
        found.append(fit_step(axis, value, np.arange(count) / rate, values, limited))
    return found


@functools.partial(jax.jit, static_argnums=0)
def _fly(count, params, loop, commands) -> jax.Array:
    """Rates, thrust and saturation (count, 5, steps) from hover to commands (steps, 4)."""
    c, none = params.vehicle.constants, jnp.zeros(gusts.START_DRAWS)

    def measure(state) -> Measurement:
        truth = plant.truth_of(params, state)
        return Measurement(truth.rates, truth.specific_force, truth.rpm, Vec3.zero())

    def one(command: jax.Array) -> jax.Array:
        target, zero = RateCommand(Vec3.of(command[:3]), command[3]), Vec3.zero()
        up = zero.replace(z=jnp.full((), -100.0))
        body = RigidBodyState(up, zero, zero, zero, Rotors.same(hover_rpm(c)), zero, zero)
        state = plant.begin(params, body, jnp.ones(()), none)

        def sample(carry, _):
            state, now = carry[0], measure(carry[0])
            inner, rpm = indi.update(loop, carry[1], now, target)
            after = plant.update(params, state, rpm, none[: gusts.DRAWS])
            ends = jnp.stack([(u <= c.rpm_min) | (u >= c.rpm_max) for u in rpm.components()])
            seen = [*now.gyro.components(), -now.specific_force.z, ends.any().astype(jnp.float32)]
            return (after, inner), jnp.stack(seen)

        return jax.lax.scan(sample, (state, indi.init(loop, measure(state))), None, count)[1]

    return jax.vmap(one, out_axes=-1)(commands)


def identify() -> None:
    """Print a line for each step, and write a row for each plant."""
    print("axis, from, to, time constant, error of the fit, motors at a limit; * not 25 to 35 ms")
    for plant_name in ("exact", "standin"):
        command = "python -m benchmarks.identify"
        row = {"name": plant_name, "command": command, "plant": [plant_name], "seeds": [0]}
        taus: dict[str, list[float]] = {axis: [] for axis in STEPS}
        for step in responses(without_effects(load_plant_config(plant_name))):
            mark = "" if EXPECTED[0] <= step.tau <= EXPECTED[1] else " *"
            limited = f"{1e3 * SECONDS * step.saturated:4.0f} ms"
            fit = f"{1e3 * step.tau:5.1f} ms {step.error:6.1%} {limited}{mark}"
            print(f"{step.axis} {step.start:6.2f} {step.target:6.2f} {fit}")
            taus[step.axis].append(1e3 * step.tau)
        texts = {
            axis: f"{statistics.median(found):.1f} ({min(found):.1f}-{max(found):.1f})"
            for axis, found in taus.items()
        }
        rows.write("identify", [row | texts])


if __name__ == "__main__":
    script(identify)
