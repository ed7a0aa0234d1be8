"""Polynomials of the authors' residual: the section ``airframe`` of the plant ``cyberzoo``.

python -m benchmarks.cyberzoo_airframe E2E.npz INDI.npz

Both published networks fly four drones with the residual of E2E.npz (docs/guide/other_trainers.md).
Terms are added one by one until one explains less than 0.8% of the variance; the drone is symmetric
but for a constant moment. Prints the section, and how much of the variance is explained.
"""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.calibration_fleet import race_config
from benchmarks.polynomials import limits_of, polynomial, variables_of
from quadjax.cli import options, script
from quadjax.core.frames import attitude, world_to_body
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant.config import NO_EFFECTS, OUTPUTS, VARIABLES, load_plant_config
from quadjax.plant.flights import PlantFlights, fly_plan, plan_race
from quadjax.policy.file import Policy
from quadjax.vehicle.residual import read_residual, residual_force_moment

RUNS, SEED, EVERY = 32, 5, 23  # flights of each network, their noise; every so many samples count
DRONES = {
    "motors.tau": (0.018, 0.018, 0.03, 0.03),
    "motors.shortfall": (0.0, 0.05, 0.05, 0.1),
    "effects.inflow": (0.0, 1.0, 0.5, 0.0),
}


def states_of(flights: PlantFlights) -> np.ndarray:
    """Propeller speeds, velocity and rates, body, of every sample in flight (n, 10)."""
    true = jax.tree.map(jnp.asarray, flights.frames.true)
    velocity = world_to_body(attitude(true.euler), true.velocity)
    vectors = (true.actuators, velocity, true.rates)
    columns = [np.asarray(x) for vector in vectors for x in vector.components()]
    return np.stack(columns, axis=-1)[~flights.frames.over][::EVERY]


def cyberzoo_airframe(e2e: options.PolicyFile, indi: options.PolicyFile, /) -> None:
    """Print the polynomials."""
    residual, states = read_residual(e2e), [np.tile([7497.0] * 4 + [0.0] * 6, (400, 1))]
    zoo = load_plant_config("cyberzoo")
    effects = NO_EFFECTS.replace(motors=1.0)
    plant = load_plant_config("standin", ["sample_rate=512", "control_rate=512"]).replace(
        effects=effects, residual=str(e2e), inner_loop="indi_simple", indi_simple=zoo.indi_simple
    )
    motors = plant.motors.replace(rpm_max=zoo.motors.rpm_max, lag=0.004)
    plant = plant.replace(motors=motors, population=DRONES)
    for name, file in {"E2E": e2e, "INDI": indi}.items():
        race = race_config(name, file)
        flown = {"runs": RUNS, "recorded": RUNS, "drones": 4, "deterministic": False}
        plan = plan_race(race, plant, Policy.load(file, race), name, **flown)
        states.append(states_of(fly_plan(plan, SEED)))
    rows = np.concatenate(states[::-1])

    def at(x: jax.Array) -> jax.Array:
        parts = Rotors.of(x[:4]), Vec3.of(x[4:7]), Vec3.of(x[7:])
        force, moment = residual_force_moment(residual, *parts)
        return jnp.stack([force, *moment.components()])

    targets = np.float64(jax.jit(jax.vmap(at))(rows.astype(np.float32)))
    values = variables_of(rows)
    ends = limits_of(values)
    values = np.clip(values, *ends)
    print(f"# {len(rows)} states")
    for output, target in zip(OUTPUTS, targets.T, strict=True):
        terms, share = polynomial(values, target, output in ("moment_x", "moment_z"))
        text = ", ".join(f'"{key}": {value:.4g}' for key, value in terms.items())
        print(f"{output}: {{{text}}}  # {share:.1%}")
    spans = (f"{key}: [{low:.3g}, {high:.3g}]" for key, (low, high) in zip(VARIABLES, ends.T))
    print(f"limits: {{{', '.join(spans)}}}")


if __name__ == "__main__":
    script(cyberzoo_airframe)
